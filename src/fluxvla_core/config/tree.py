"""A config as data: one plain tree, and the place that each key of it came from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any

from fluxvla_core.config import keys
from fluxvla_core.errors import Problem

DELETE = "_delete_"


@dataclass(frozen=True)
class Config:
    """One config.

    Args:
        tree: tables (dict), lists and scalars (str, int, float, bool, None); nothing else, so
            that a run and the ``config.resolved.json`` that it wrote build the same objects.
        origins: dotted key -> ``file:line`` (or the ``--set`` that put it there).
        file: the file that was asked for, as messages show it.
        left_over: keys whose table got another ``type`` from a file that inherits theirs, and
            that this file did not repeat: they were written for another class.
    """

    tree: dict[str, Any]
    origins: Mapping[str, str] = field(default_factory=dict)
    file: str = ""
    left_over: frozenset[str] = frozenset()

    def where(self, key: str) -> str:
        """The place of ``key``, or of the nearest table around it that has one."""
        while key:
            if key in self.origins:
                return self.origins[key]
            key = keys.parent(key)
        return self.file

    def problem(self, key: str, what: str) -> Problem:
        return Problem(self.where(key), key, what)


def shown(path: Path) -> str:
    """``path`` as people read it: relative where that is shorter than climbing out."""
    try:
        return str(path.resolve().relative_to(Path.cwd().resolve()))
    except (ValueError, OSError):
        return str(path)


def plain(value: Any, key: str, problems: list[tuple[str, str]]) -> Any:
    """A copy of ``value`` in plain data: tuples become lists, paths strings.

    What is no data is left out and appended to ``problems`` as (key, finding).
    """
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, PurePath):
        return str(value)
    if isinstance(value, (list, tuple)):
        return [plain(item, keys.child(key, i), problems) for i, item in enumerate(value)]
    if isinstance(value, Mapping):
        out = {}
        for name, item in value.items():
            if not isinstance(name, str):
                problems.append((key, f"a key must be a string: write {str(name)!r}, not {name!r}"))
                continue
            out[name] = plain(item, keys.child(key, name), problems)
        return out
    if isinstance(value, type) and keys.split(key)[-1:] == ["type"]:
        problems.append((key, f"type must be a string: write type={value.__name__!r}"))
        return None
    problems.append(
        (
            key,
            f"a config holds plain data (text, numbers, True, None, lists, tables), "
            f"not a {type(value).__module__}.{type(value).__qualname__}",
        )
    )
    return None


def strip(value: Any) -> Any:
    """``value`` without ``_delete_`` marks: where nothing was inherited they say nothing."""
    if isinstance(value, dict):
        return {k: strip(v) for k, v in value.items() if k != DELETE}
    if isinstance(value, list):
        return [strip(item) for item in value]
    return value
