"""What a class's constructor takes, with ``**kwargs`` followed into its base classes."""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

from fluxvla_core.config.source import Module, Opaque, Source, dotted_name, find, linearize
from fluxvla_core.plugins._metadata import Plugin


@dataclass(frozen=True)
class Parameter:
    """One constructor parameter; ``text`` is its annotation and default as written."""

    name: str
    required: bool
    place: str
    text: str = ""


@dataclass(frozen=True)
class Forward:
    """How an ``__init__`` hands its ``**kwargs`` to the next one."""

    positional: int = 0
    named: frozenset[str] = frozenset()
    filled: frozenset[str] = frozenset()
    taken: tuple[Parameter, ...] = ()


@dataclass(frozen=True)
class Init:
    """One ``__init__`` on the way up. ``forward`` is None if ``**kwargs`` go nowhere."""

    parameters: tuple[Parameter, ...]
    keywords: bool = False
    forward: Forward | None = None


@dataclass(frozen=True)
class Signature:
    """What a config may say for a class.

    ``open`` means that further keys cannot be ruled out (``**kwargs`` that go nowhere known).
    """

    name: str
    place: str
    parameters: tuple[Parameter, ...]
    open: bool = False
    doc: str = ""
    api: str | None = None
    trains: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.parameters)


def of_plugin(plugin: Plugin) -> Signature | None:
    """The signature of an installed class from its source; None where there is none to read."""
    source = find(plugin.module, plugin.attribute)
    if isinstance(source, Opaque):
        return None
    node = source.node
    if isinstance(node, ast.FunctionDef):
        init = _init(node, source.module, drop_self=False)
        return Signature(node.name, source.place, init.parameters, init.keywords, _doc(node))
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
    parameters, is_open = combine(inits, unknown)
    return Signature(
        node.name,
        source.place,
        parameters,
        is_open,
        _doc(node),
        _literal(order, "api"),
        _trains(order),
    )


def of_class(cls: Any) -> Signature:
    """The signature of a class that this process registered."""
    if not inspect.isclass(cls):
        raise TypeError(f"{cls!r} is not a class")
    inits: list[Init] = []
    unknown = False
    for base in cls.__mro__[:-1]:
        init = base.__dict__.get("__init__")
        if init is None:
            continue
        if f"{base.__module__}.{base.__name__}" == "torch.nn.modules.module.Module":
            break
        if not inspect.isfunction(init):
            unknown = True
            break
        inits.append(_runtime_init(init))
    parameters, is_open = combine(inits, unknown)
    method = getattr(cls, "run_setup", None)
    trains = callable(method) and "n_train_examples" in inspect.signature(method).parameters
    doc = (inspect.getdoc(cls) or "").partition("\n")[0]
    api = getattr(cls, "api", None)
    return Signature(
        cls.__name__, _class_place(cls), parameters, is_open, doc, api and str(api), trains
    )


def combine(inits: Iterable[Init], unknown: bool = False) -> tuple[tuple[Parameter, ...], bool]:
    """The parameters that reach some ``__init__`` of the chain, and whether others may.

    Args:
        inits: from the class upwards.
        unknown: whether the chain ends in a class whose constructor could not be read.
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
        if not init.keywords:
            return tuple(reached.values()), False
        if init.forward is None:
            return tuple(reached.values()), True
        for parameter in init.forward.taken:
            reached.setdefault(parameter.name, parameter)
        blocked |= init.forward.named | {p.name for p in init.parameters}
        filled |= init.forward.filled
        skip = init.forward.positional
    return tuple(reached.values()), unknown


# -- from source -----------------------------------------------------------------------------


def _class_init(base: Source, order: list[Any]) -> Init | None:
    node = base.node
    assert isinstance(node, ast.ClassDef)
    methods = [n for n in node.body if isinstance(n, ast.FunctionDef) and n.name == "__init__"]
    if methods:
        return _init(methods[-1], base.module)
    if _is_dataclass(node):
        return Init(_fields(order[order.index(base) :]))
    return None


def _init(node: ast.FunctionDef, module: Module | None, drop_self: bool = True) -> Init:
    def place(line: int) -> str:
        return module.place(line) if module else ""

    spec = node.args
    plain = [*spec.posonlyargs, *spec.args][1 if drop_self else 0 :]
    defaults = [*[None] * (len(plain) - len(spec.defaults)), *spec.defaults, *spec.kw_defaults]
    pairs = zip([*plain, *spec.kwonlyargs], defaults, strict=True)
    parameters = tuple(
        Parameter(a.arg, d is None, place(a.lineno), _text(a.annotation, d)) for a, d in pairs
    )
    if spec.kwarg is None:
        return Init(parameters)
    return Init(parameters, True, _forward(node, spec.kwarg.arg, place))


def _text(annotation: ast.expr | None, default: ast.expr | None) -> str:
    left = f": {ast.unparse(annotation)}" if annotation else ""
    return f"{left} = {ast.unparse(default)}" if default else left


def _forward(node: ast.FunctionDef, kwargs: str, place: Any) -> Forward | None:
    """The call ``super().__init__(..., **kwargs)`` (or ``Base.__init__(self, ..., **kwargs)``)."""
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
                frozenset(filled),
                tuple(taken),
            )
    return None


def _item(target: ast.expr, kwargs: str) -> str | None:
    if isinstance(target, ast.Subscript) and dotted_name(target.value) == kwargs:
        index = target.slice
        if isinstance(index, ast.Constant) and isinstance(index.value, str):
            return index.value
    return None


def _is_dataclass(node: ast.ClassDef) -> bool:
    return any(
        (dotted_name(d.func if isinstance(d, ast.Call) else d) or "").rpartition(".")[2]
        == "dataclass"
        for d in node.decorator_list
    )


def _fields(order: list[Any]) -> tuple[Parameter, ...]:
    """Fields of a dataclass and of the dataclasses that it inherits from, bases first."""
    found: dict[str, Parameter] = {}
    for base in reversed(order):
        if not isinstance(base, Source) or not isinstance(base.node, ast.ClassDef):
            continue
        if not _is_dataclass(base.node):
            continue
        for node in base.node.body:
            if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
                continue
            kind = (dotted_name(node.annotation) or "").rpartition(".")[2]
            if kind in {"ClassVar", "KW_ONLY"} or _left_out(node.value):
                continue
            found[node.target.id] = Parameter(
                node.target.id,
                not _has_default(node.value),
                base.module.place(node.lineno),
                _text(node.annotation, node.value),
            )
    return tuple(found.values())


def _field_options(value: ast.expr | None) -> dict[str, ast.expr] | None:
    if isinstance(value, ast.Call) and (dotted_name(value.func) or "").endswith("field"):
        return {k.arg: k.value for k in value.keywords if k.arg}
    return None


def _left_out(value: ast.expr | None) -> bool:
    option = (_field_options(value) or {}).get("init")
    return isinstance(option, ast.Constant) and option.value is False


def _has_default(value: ast.expr | None) -> bool:
    options = _field_options(value)
    if options is None:
        return value is not None
    return "default" in options or "default_factory" in options


def _doc(node: ast.ClassDef | ast.FunctionDef) -> str:
    return (ast.get_docstring(node) or "").partition("\n")[0]


def _literal(order: list[Any], name: str) -> str | None:
    """The class attribute ``name`` where it is a string literal."""
    for base in order:
        for node in base.node.body if isinstance(base, Source) else ():
            targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", 0)]
            if any(isinstance(t, ast.Name) and t.id == name for t in targets):
                value = getattr(node, "value", None)
                return str(value.value) if isinstance(value, ast.Constant) else None
    return None


def _trains(order: list[Any]) -> bool:
    """Whether ``run_setup`` takes ``n_train_examples``: what tells a train runner."""
    for base in order:
        for node in base.node.body if isinstance(base, Source) else ():
            if isinstance(node, ast.FunctionDef) and node.name == "run_setup":
                spec = node.args
                return any(a.arg == "n_train_examples" for a in (*spec.args, *spec.kwonlyargs))
    return False


# -- from a class that is there --------------------------------------------------------------


def _runtime_init(function: Any) -> Init:
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
        node = tree.body[0]
    except (OSError, SyntaxError):  # made in a notebook cell, or by a decorator (dataclass)
        node = None
    found = list(inspect.signature(function).parameters.values())[1:]
    code = function.__code__
    place = f"{code.co_filename}:{code.co_firstlineno}"
    parameters = tuple(
        Parameter(p.name, p.default is p.empty, place, str(p)[len(p.name) :])
        for p in found
        if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)
    )
    keywords = [p.name for p in found if p.kind is p.VAR_KEYWORD]
    if not keywords:
        return Init(parameters)
    if not isinstance(node, ast.FunctionDef):
        return Init(parameters, True, Forward())
    return Init(parameters, True, _forward(node, keywords[0], lambda line: place))


def _class_place(cls: type) -> str:
    try:
        return f"{inspect.getsourcefile(cls)}:{inspect.getsourcelines(cls)[1]}"
    except (OSError, TypeError):
        return cls.__module__
