"""Inheritance: tables merge key by key, everything else (**lists too**) replaces."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any

from fluxvla_core.config import keys
from fluxvla_core.config.tree import DELETE, Config, strip
from fluxvla_core.errors import ConfigError, Problem


def merge(base: Config, over: Config) -> Config:
    """``over`` on top of ``base``; every key keeps the place that its value was written at.

    ``_delete_ = True`` in a table of ``over`` replaces the inherited table instead of merging
    into it; alone in a table it removes the key. ``None`` may replace a table and be replaced by
    one (that is how an option is switched off and on).

    Raises:
        ConfigError: a table meets a scalar or a list, or ``_delete_`` is no boolean; all at once.
    """
    tree, origins, left_over = copy.deepcopy(base.tree), dict(base.origins), set(base.left_over)
    problems: list[Problem] = []

    def put(into: dict[str, Any], name: str, value: Any, key: str) -> None:
        for old in [k for k in origins if keys.within(k, key)]:
            del origins[old]
        for new, place in over.origins.items():
            if keys.within(new, key):
                origins[new] = place
        left_over.difference_update([k for k in left_over if keys.within(k, key)])
        left_over.update(k for k in over.left_over if keys.within(k, key))
        into[name] = strip(copy.deepcopy(value))

    def walk(into: dict[str, Any], new: dict[str, Any], at: str) -> None:
        if _another_type(into, new):
            left_over.update(keys.child(at, name) for name in into.keys() - new.keys())
        for name, value in new.items():
            if name == DELETE:
                continue
            key = keys.child(at, name)
            old = into.get(name)
            mark = value.get(DELETE) if isinstance(value, dict) else None
            if mark is not None and not isinstance(mark, bool):
                problems.append(over.problem(key, f"{DELETE} must be True or False, got {mark!r}"))
            elif mark:
                put(into, name, value, key)
                if value.keys() == {DELETE}:
                    del into[name]
            elif isinstance(old, dict) and isinstance(value, dict):
                if key in over.origins:
                    origins[key] = over.origins[key]
                walk(old, value, key)
            elif _clash(old, value):
                problems.append(
                    over.problem(
                        key,
                        f"a {_kind(value)} cannot replace the {_kind(old)} inherited from "
                        f"{base.where(key)}; {_way_on(value)}",
                    )
                )
            else:
                put(into, name, value, key)

    walk(tree, over.tree, "")
    if problems:
        raise ConfigError.from_problems(tuple(problems))
    return Config(tree, origins, over.file, frozenset(left_over))


def join_bases(bases: list[Config]) -> Config:
    """Several bases side by side; the order must not matter, so no key may be in two.

    A key that both inherit from one common base (same place) is no conflict.

    Raises:
        ConfigError: two bases define a key.
    """
    joined = bases[0]
    problems: list[Problem] = []
    for base in bases[1:]:
        theirs = set(_values(base.tree))
        for key in _values(joined.tree):
            if key in theirs and joined.where(key) != base.where(key):
                problems.append(
                    base.problem(key, f"another base defines it too, at {joined.where(key)}")
                )
        if not problems:
            joined = merge(joined, base)
    if problems:
        raise ConfigError.from_problems(
            tuple(problems), next="keep the key in one of the bases, or let one inherit the other"
        )
    return joined


def _another_type(old: dict[str, Any], new: dict[str, Any]) -> bool:
    """Whether ``new`` makes another class of the table ``old``."""
    return "type" in old and new.get("type", old["type"]) != old["type"]


def _clash(old: Any, new: Any) -> bool:
    """Whether one of them is a table and the other a value that is no 'off'."""
    return isinstance(old, dict) != isinstance(new, dict) and old is not None and new is not None


def _values(table: dict[str, Any], at: str = "") -> Iterator[str]:
    """Keys of everything that merging treats as one value: all but tables."""
    for name, value in table.items():
        key = keys.child(at, name)
        if isinstance(value, dict) and value:
            yield from _values(value, key)
        else:
            yield key


def _kind(value: Any) -> str:
    if isinstance(value, dict):
        return "table"
    return "list" if isinstance(value, list) else "single value"


def _way_on(value: Any) -> str:
    if isinstance(value, dict):
        return f"if you mean it, write {DELETE}=True in the table"
    return "write a table, or None to switch it off"
