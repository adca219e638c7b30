"""Which values of a table do not fit the annotations of the constructor that refused it.

Annotations in the wild are too often wrong to refuse a config by them; where a constructor fails
by itself, they are the best guess at which key it was.
"""

from __future__ import annotations

import inspect
import types
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

_SCALARS = (bool, int, float, str)


@dataclass(frozen=True)
class Misfit:
    """A key whose value is none of the types that its parameter is annotated with."""

    name: str
    expected: str
    value: Any

    def __str__(self) -> str:
        return f"{self.name!r} must be {self.expected}, got {self.value!r}"


def misfits(cls: type, values: Mapping[str, Any]) -> list[Misfit]:
    """The values that cannot be what the constructor of ``cls``, or of a base, asks for."""
    found = []
    hints = _hints(cls)
    for name, value in values.items():
        hint = hints.get(name)
        if hint is not None and not _fits(value, hint):
            expected = hint.__name__ if inspect.isclass(hint) else str(hint)
            found.append(
                Misfit(name, expected.replace("typing.", "").replace("collections.abc.", ""), value)
            )
    return found


def _hints(cls: type) -> dict[str, Any]:
    hints: dict[str, Any] = {}
    for base in reversed(inspect.getmro(cls)):
        init = base.__dict__.get("__init__")
        if init is not None and base is not object:
            try:
                hints |= typing.get_type_hints(init)
            except (NameError, TypeError, AttributeError):
                continue  # imported for type checkers alone, or nothing that can be read
    return hints


def _fits(value: Any, hint: Any) -> bool:
    """Whether it may; anything that is not plain counts as fitting."""
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
