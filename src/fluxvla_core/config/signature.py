"""Constructor signatures, read from source: nothing is imported.

``**kwargs`` are followed into the constructors of base classes, ``**options`` into the fields of
the dataclass that the class attribute ``Options`` names. Descriptions come from docstrings.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from fluxvla_core.config.parameters import (
    Parameter,
    dataclass_fields,
    is_dataclass,
    is_dataclass_source,
    options_order,
)
from fluxvla_core.config.source import (
    Module,
    Opaque,
    Source,
    argument_texts,
    assigned,
    dotted_name,
    field_texts,
    find,
    linearize,
)
from fluxvla_core.plugins._metadata import Plugin

OPTIONS_KEYWORDS = "options"
_ANY_TABLE = frozenset({"None", "Mapping", "dict", "Dict"})


@dataclass(frozen=True)
class Forward:
    """The call that passes ``**kwargs`` of an ``__init__`` to that of a base class."""

    positional: int = 0
    named: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Init:
    """One ``__init__`` of a class or a base class.

    Args:
        parameters: its own.
        kwargs: the name of its ``**kwargs``; None if it has none.
        forward: None if ``**kwargs`` go nowhere known.
        filled: keywords that it sets itself where the caller did not.
        taken: keywords that it takes out of ``**kwargs``.
    """

    parameters: tuple[Parameter, ...]
    kwargs: str | None = None
    forward: Forward | None = None
    filled: frozenset[str] = frozenset()
    taken: tuple[Parameter, ...] = ()


@dataclass(frozen=True)
class Signature:
    """The keys that a config may set for a class.

    ``open`` means that further keys cannot be ruled out (``**kwargs`` that go nowhere known);
    ``documented`` reads descriptions of parameters, those of the class before those of its bases.
    """

    name: str
    place: str
    parameters: tuple[Parameter, ...]
    open: bool = False
    doc: str = ""
    api: str | None = None
    trains: bool = False
    documented: Callable[[], Mapping[str, str]] = dict

    @property
    def meanings(self) -> Mapping[str, str]:
        """Each parameter's description, where a docstring has one."""
        return self.documented()

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.parameters)


def read_signature(plugin: Plugin) -> Signature | None:
    """The signature of an installed class from its source; None where there is none to read."""
    source = find(plugin.module, plugin.attribute)
    if isinstance(source, Opaque):
        return None
    node = source.node
    if isinstance(node, ast.FunctionDef):
        init = _init(node, source.module, drop_self=False)
        return Signature(
            node.name,
            source.place,
            init.parameters,
            init.kwargs is not None,
            _doc(node),
            documented=lambda: argument_texts(ast.get_docstring(node)),
        )
    order = linearize(source)
    inits: list[Init] = []
    unknown = False
    for base in order:
        if isinstance(base, Opaque):
            unknown = unknown or not base.plain
        elif isinstance(base.node, ast.ClassDef):
            found = _class_init(base, order)
            if found is not None and not unknown:
                inits.append(found)
    options = options_order(order)
    parameters, is_open = combine(inits, unknown, dataclass_fields(options) if options else None)
    return Signature(
        node.name,
        source.place,
        parameters,
        is_open,
        _doc(node),
        _literal(order, "api"),
        _trains(order),
        lambda: {**_meanings(options), **_meanings(order)},
    )


def table_of(parameter: Parameter) -> Signature | None:
    """The keys of a table whose parameter is annotated with a dataclass or a TypedDict.

    Alone, or with None and ``Mapping``: ``LoraOptions | Mapping[str, Any] | None``. None for every
    other annotation, and for classes whose source cannot be read.
    """
    annotation = None if isinstance(parameter.stated, str) else parameter.stated[0]
    if annotation is None or not parameter.module:
        return None
    named = [n for n in _alternatives(annotation) if n.rpartition(".")[2] not in _ANY_TABLE]
    source = find(parameter.module, named[0]) if len(named) == 1 and named[0] else None
    if not isinstance(source, Source) or not isinstance(source.node, ast.ClassDef):
        return None
    order = linearize(source)
    typed = any(_is_typed_dict(base) for base in order)
    known = all(isinstance(base, Source) or base.plain for base in order)
    if not typed and (not known or not is_dataclass_source(source) or _init_of(source.node)):
        return None
    found = dataclass_fields(order, _is_typed_dict if typed else is_dataclass_source)
    return Signature(source.node.name, source.place, found, documented=lambda: _meanings(order))


def read_help(plugin: Plugin) -> str:
    """The ``help`` of a command's class as its source has it; empty where it cannot be read."""
    source = find(plugin.module, plugin.attribute)
    return "" if isinstance(source, Opaque) else _literal(linearize(source), "help") or ""


def implements(plugin: Plugin, contract: str, method: str) -> bool | None:
    """Whether an installed class, or a base of it, has ``method`` itself.

    Args:
        contract: the module of its contract, whose default does not count.

    Returns:
        None where that cannot be read from sources.
    """
    source = find(plugin.module, plugin.attribute)
    if isinstance(source, Opaque) or isinstance(source.node, ast.FunctionDef):
        return None
    order = linearize(source)
    bodies = [b.node.body for b in order if isinstance(b, Source) and b.module.name != contract]
    if any(isinstance(n, ast.FunctionDef) and n.name == method for body in bodies for n in body):
        return True
    unread = any(isinstance(base, Opaque) and not base.plain for base in order)
    return None if unread else False


def combine(
    inits: Iterable[Init], unknown: bool, options: Sequence[Parameter] | None
) -> tuple[tuple[Parameter, ...], bool]:
    """The parameters that reach some ``__init__`` of the chain, and whether others may.

    Args:
        inits: from the class upwards.
        unknown: whether the chain ends in a class whose constructor could not be read.
        options: fields of the class's ``Options``, for an ``__init__`` that ends the chain and
            takes ``**options``; None if it has none.
    """
    reached: dict[str, Parameter] = {}
    blocked: set[str] = set()
    filled: set[str] = set()
    skip = 0
    for init in inits:
        for index, parameter in enumerate(init.parameters):
            if index >= skip and parameter.name not in blocked:
                required = parameter.required and parameter.name not in filled
                reached.setdefault(parameter.name, replace(parameter, required=required))
        if init.kwargs is None:
            return tuple(reached.values()), False
        for parameter in init.taken:
            reached.setdefault(parameter.name, parameter)
        blocked |= {p.name for p in init.parameters}
        filled |= init.filled
        if init.forward is None:
            if options is None or init.kwargs != OPTIONS_KEYWORDS:
                return tuple(reached.values()), True
            for option in options:
                if option.name not in blocked:
                    required = option.required and option.name not in filled
                    reached.setdefault(option.name, replace(option, required=required))
            return tuple(reached.values()), False
        blocked |= init.forward.named
        skip = init.forward.positional
    return tuple(reached.values()), unknown


# -- from source -----------------------------------------------------------------------------


def _class_init(base: Source, order: list[Any]) -> Init | None:
    node = base.node
    assert isinstance(node, ast.ClassDef)
    init = _init_of(node)
    if init is not None:
        return _init(init, base.module)
    if is_dataclass(node):
        return Init(dataclass_fields(order[order.index(base) :]))
    return None


def _init_of(node: ast.ClassDef | ast.FunctionDef) -> ast.FunctionDef | None:
    found = [n for n in node.body if isinstance(n, ast.FunctionDef) and n.name == "__init__"]
    return found[-1] if found else None


def _init(node: ast.FunctionDef, module: Module, drop_self: bool = True) -> Init:
    spec = node.args
    plain = [*spec.posonlyargs, *spec.args][1 if drop_self else 0 :]
    defaults = [*[None] * (len(plain) - len(spec.defaults)), *spec.defaults, *spec.kw_defaults]
    pairs = zip([*plain, *spec.kwonlyargs], defaults, strict=True)
    parameters = tuple(
        Parameter(a.arg, d is None, module.place(a.lineno), (a.annotation, d), module.name)
        for a, d in pairs
    )
    if spec.kwarg is None:
        return Init(parameters)
    return with_kwargs(parameters, node, spec.kwarg.arg, module.place)


def with_kwargs(
    parameters: tuple[Parameter, ...],
    node: ast.FunctionDef,
    kwargs: str,
    place: Callable[[int], str],
) -> Init:
    """An ``__init__`` with ``**kwargs``: the keys that it sets, pops and passes on."""
    filled: set[str] = set()
    taken: list[Parameter] = []
    for inner in ast.walk(node):
        if isinstance(inner, ast.Assign):
            for target in inner.targets:
                name = _item(target, kwargs)
                if name:
                    filled.add(name)
        elif isinstance(inner, ast.Call) and isinstance(inner.func, ast.Attribute):
            owner, method = dotted_name(inner.func.value), inner.func.attr
            first = inner.args[0] if inner.args else None
            if owner == kwargs and isinstance(first, ast.Constant) and isinstance(first.value, str):
                if method == "setdefault":
                    filled.add(first.value)
                elif method == "pop":
                    taken.append(Parameter(first.value, len(inner.args) == 1, place(inner.lineno)))
    forward = _forward(node, kwargs)
    return Init(parameters, kwargs, forward, frozenset(filled), tuple(taken))


def _forward(node: ast.FunctionDef, kwargs: str) -> Forward | None:
    """The call ``super().__init__(..., **kwargs)`` (or ``Base.__init__(self, ..., **kwargs)``)."""
    for inner in ast.walk(node):
        if not isinstance(inner, ast.Call) or not isinstance(inner.func, ast.Attribute):
            continue
        passed = any(k.arg is None and dotted_name(k.value) == kwargs for k in inner.keywords)
        if inner.func.attr == "__init__" and passed:
            given = [a for a in inner.args if not isinstance(a, ast.Starred)]
            explicit = dotted_name(inner.func.value) is not None  # Base.__init__(self, ...)
            return Forward(
                len(given) - explicit,
                frozenset(k.arg for k in inner.keywords if k.arg),
            )
    return None


def _item(target: ast.expr, kwargs: str) -> str | None:
    if isinstance(target, ast.Subscript) and dotted_name(target.value) == kwargs:
        index = target.slice
        if isinstance(index, ast.Constant) and isinstance(index.value, str):
            return index.value
    return None


def _alternatives(node: ast.expr) -> list[str]:
    """The names in a union: ``X | None``, ``Optional[X]``, ``"X"``; "" for what is not a name."""
    if isinstance(node, ast.BinOp):
        return [*_alternatives(node.left), *_alternatives(node.right)]
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        with suppress(SyntaxError):
            return _alternatives(ast.parse(node.value, mode="eval").body)
    if isinstance(node, ast.Constant) and node.value is None:
        return ["None"]
    name = dotted_name(node) or ""
    if isinstance(node, ast.Subscript) and name.rpartition(".")[2] in ("Optional", "Union"):
        inner = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        return ["None", *(one for each in inner for one in _alternatives(each))]
    return [name]


def _is_typed_dict(base: Any) -> bool:
    """Whether it is a TypedDict, or one that inherits from another."""
    if not isinstance(base, Source) or not isinstance(base.node, ast.ClassDef):
        return False
    names = [dotted_name(b) or "" for b in base.node.bases]
    if any(name.rpartition(".")[2] == "TypedDict" for name in names):
        return True
    return any(_is_typed_dict(find(base.module.name, name)) for name in names if name)


def _doc(node: ast.ClassDef | ast.FunctionDef) -> str:
    return (ast.get_docstring(node) or "").partition("\n")[0]


def _meanings(order: list[Any]) -> dict[str, str]:
    """Descriptions of parameters from the docstrings of these classes; the first one counts."""
    found: dict[str, str] = {}
    for base in order:
        if isinstance(base, Source):
            found = {**_argument_texts_of(base.node), **found}
    return found


def _argument_texts_of(node: ast.ClassDef | ast.FunctionDef) -> dict[str, str]:
    """From strings below the fields of a class, its docstring, and its ``__init__``'s."""
    init = _init_of(node)
    found = argument_texts(ast.get_docstring(init)) if init else {}
    found |= argument_texts(ast.get_docstring(node))
    return found | (field_texts(node) if isinstance(node, ast.ClassDef) else {})


def _literal(order: list[Any], name: str) -> str | None:
    """The class attribute ``name`` where it is a string literal."""
    for base in order:
        value = assigned(base.node, name) if isinstance(base, Source) else None
        if value is not None:
            return str(value.value) if isinstance(value, ast.Constant) else None
    return None


def _trains(order: list[Any]) -> bool:
    """Whether ``run_setup`` takes ``n_train_examples``: what distinguishes a train runner."""
    for base in order:
        for node in base.node.body if isinstance(base, Source) else ():
            if isinstance(node, ast.FunctionDef) and node.name == "run_setup":
                spec = node.args
                return any(a.arg == "n_train_examples" for a in (*spec.args, *spec.kwonlyargs))
    return False
