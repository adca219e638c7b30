"""Constructor arguments of loaded classes, and values that do not fit their annotations."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import textwrap
import types
import typing
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from fluxvla_core.config.parameters import OPTIONS, Parameter
from fluxvla_core.config.signature import (
    Forward,
    Init,
    Signature,
    combine,
    with_kwargs,
)
from fluxvla_core.config.source import argument_texts, field_texts
from fluxvla_core.contracts.check import is_train_runner

_SCALARS = (bool, int, float, str)


def inspect_signature(cls: Any) -> Signature:
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
    options = options_class(cls)
    parameters, is_open = combine(inits, unknown, option_fields(cls) if options else None)
    doc = (inspect.getdoc(cls) or "").partition("\n")[0]
    api = getattr(cls, "api", None)
    place, version = _class_place(cls), None if api is None else str(api)

    def documented() -> dict[str, str]:
        return {**(_runtime_meanings(options) if options else {}), **_runtime_meanings(cls)}

    trains = is_train_runner(cls)
    return Signature(cls.__name__, place, parameters, is_open, doc, version, trains, documented)


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
        return Init(parameters, keywords[0], Forward())
    return with_kwargs(parameters, node, keywords[0], lambda line: place)


def options_class(cls: type) -> type | None:
    """The dataclass that the class attribute ``Options`` names, or None."""
    found = getattr(cls, OPTIONS, None)
    return found if inspect.isclass(found) and dataclasses.is_dataclass(found) else None


def option_fields(cls: type) -> tuple[Parameter, ...]:
    """The fields of a class's ``Options``, each with the place of the class that states it."""
    options: Any = options_class(cls)
    if options is None:
        return ()
    names = option_names(cls)
    places: dict[str, str] = {}
    for base in reversed(options.__mro__):
        own = names & set(inspect.get_annotations(base))
        places |= dict.fromkeys(own, _class_place(base) if own else "")
    return tuple(
        replace(parameter, place=places[parameter.name])
        for parameter in _runtime_init(options.__init__).parameters
        if parameter.name in names
    )


def option_names(cls: type) -> set[str]:
    """The names of the fields of a class's ``Options``; none where it has no such class."""
    options: Any = options_class(cls)
    if options is None:
        return set()
    return {field.name for field in dataclasses.fields(options) if field.init}


def _runtime_meanings(cls: type) -> dict[str, str]:
    meanings: dict[str, str] = {}
    for base in cls.__mro__[:-1]:
        init = base.__dict__.get("__init__")
        texts = argument_texts(init.__doc__) if inspect.isfunction(init) else {}
        texts |= argument_texts(base.__doc__) | field_texts(_class_node(base))
        meanings = {**texts, **meanings}
    return meanings


def _class_node(cls: type) -> ast.ClassDef:
    """A class's statement; an empty one where its source cannot be read."""
    with suppress(OSError, TypeError, SyntaxError, IndexError):
        node = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0]
        if isinstance(node, ast.ClassDef):
            return node
    return ast.ClassDef(cls.__name__, [], [], [], [])


def _class_place(cls: type) -> str:
    try:
        return f"{inspect.getsourcefile(cls)}:{inspect.getsourcelines(cls)[1]}"
    except (OSError, TypeError):
        return cls.__module__


# -- values and annotations ----------------------------------------------------------------------


@dataclass(frozen=True)
class TypeMismatch:
    """A key whose value has none of the annotated types of its parameter."""

    name: str
    expected: str
    value: Any

    def __str__(self) -> str:
        return f"{self.name!r} must be {self.expected}, got {self.value!r}"


def type_mismatches(cls: type, values: Mapping[str, Any]) -> list[TypeMismatch]:
    """The values that do not fit the annotations of the constructor of ``cls`` or of a base."""
    found = []
    hints = _hints(cls)
    for name, value in values.items():
        hint = hints.get(name)
        if hint is not None and not _fits(value, hint):
            expected = hint.__name__ if inspect.isclass(hint) else str(hint)
            found.append(
                TypeMismatch(
                    name, expected.replace("typing.", "").replace("collections.abc.", ""), value
                )
            )
    return found


def _hints(cls: type) -> dict[str, Any]:
    hints: dict[str, Any] = {}
    options = options_class(cls)
    if options is not None:
        hints |= _hints(options)
    for base in reversed(inspect.getmro(cls)):
        init = base.__dict__.get("__init__")
        if init is not None and base is not object:
            try:
                hints |= typing.get_type_hints(init)
            except (NameError, TypeError, AttributeError):
                continue  # imported for type checkers alone, or nothing that can be read
    return hints


def _fits(value: Any, hint: Any) -> bool:
    """Whether ``value`` may be a ``hint``; unknown annotations fit everything."""
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, one) for one in typing.get_args(hint))
    if hint is None or hint is type(None):
        return value is None
    if hint in _SCALARS:
        if isinstance(value, bool) or hint is bool:
            return isinstance(value, bool) and hint is bool
        return isinstance(value, (int, float) if hint is float else hint)
    if origin in (Mapping, dict):
        return isinstance(value, Mapping)
    if origin in (Sequence, list, tuple):
        return isinstance(value, list | tuple)
    return True
