"""Parameters of constructors and fields of dataclasses, from source."""

from __future__ import annotations

import ast
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from fluxvla_core.config.source import Source, dotted_name, linearize, member

OPTIONS = "Options"
"""The class attribute that names the dataclass of a constructor's ``**options``."""


@dataclass(frozen=True)
class Parameter:
    """One constructor parameter.

    Args:
        stated: its annotation and default, as written or as nodes of its source.
        module: the module of that source.
    """

    name: str
    required: bool
    place: str
    stated: str | tuple[ast.expr | None, ast.expr | None] = ""
    module: str = ""

    @property
    def text(self) -> str:
        """Its annotation and default as written: ``: int = 3``."""
        if isinstance(self.stated, str):
            return self.stated
        left = f": {self.annotation}" if self.annotation else ""
        return f"{left} = {self.default}" if self.default else left

    @property
    def annotation(self) -> str | None:
        """Its annotation as source; None if it has none."""
        return self._part(0)

    @property
    def default(self) -> str | None:
        """Its default as source; None if it has none."""
        return self._part(1)

    def _part(self, index: int) -> str | None:
        part = self.nodes[index]
        return ast.unparse(part) if part else None

    @property
    def nodes(self) -> tuple[ast.expr | None, ast.expr | None]:
        """Its annotation and default as nodes; what cannot be parsed (a repr) is None."""
        if not isinstance(self.stated, str):
            return self.stated
        with suppress(SyntaxError):
            stated = ast.parse(f"def f({self.name}{self.stated}): ...").body[0]
            if isinstance(stated, ast.FunctionDef):
                spec = stated.args
                return spec.args[0].annotation, spec.defaults[0] if spec.defaults else None
        return None, None


def dataclass_fields(
    order: list[Any], counts: Callable[[Any], bool] | None = None
) -> tuple[Parameter, ...]:
    """Fields of a dataclass and of the dataclasses that it inherits from, bases first.

    Args:
        counts: whether a class has fields; dataclasses by default.
    """
    found: dict[str, Parameter] = {}
    for base in reversed(order):
        if not (counts or is_dataclass_source)(base):
            continue
        for node in base.node.body:
            if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
                continue
            kind = (dotted_name(node.annotation) or "").rpartition(".")[2]
            if kind in {"ClassVar", "KW_ONLY"} or _left_out(node.value):
                continue
            name, default = node.target.id, _default(node.value)
            place, stated = base.module.place(node.lineno), (node.annotation, default)
            found[name] = Parameter(name, default is None, place, stated, base.module.name)
    return tuple(found.values())


def options_order(order: list[Any]) -> list[Any]:
    """The dataclass that the class attribute ``Options`` names, and its bases; empty if none."""
    for base in order:
        found = member(base, OPTIONS) if isinstance(base, Source) else None
        if found is not None:
            is_data = isinstance(found, Source) and isinstance(found.node, ast.ClassDef)
            bases = linearize(found) if is_data and isinstance(found, Source) else []
            return bases if any(is_dataclass_source(one) for one in bases) else []
    return []


def is_dataclass_source(base: Any) -> bool:
    return (
        isinstance(base, Source) and isinstance(base.node, ast.ClassDef) and is_dataclass(base.node)
    )


def _field_options(value: ast.expr | None) -> dict[str, ast.expr] | None:
    if isinstance(value, ast.Call) and (dotted_name(value.func) or "").endswith("field"):
        return {k.arg: k.value for k in value.keywords if k.arg}
    return None


def _left_out(value: ast.expr | None) -> bool:
    option = (_field_options(value) or {}).get("init")
    return isinstance(option, ast.Constant) and option.value is False


def _default(value: ast.expr | None) -> ast.expr | None:
    """A field's default as an expression; a factory's is the call of it."""
    options = _field_options(value)
    if options is None:
        return value
    factory = options.get("default_factory")
    return ast.Call(factory, [], []) if factory else options.get("default")


def is_dataclass(node: ast.ClassDef | ast.FunctionDef) -> bool:
    return any(
        (dotted_name(d.func if isinstance(d, ast.Call) else d) or "").rpartition(".")[2]
        == "dataclass"
        for d in node.decorator_list
    )
