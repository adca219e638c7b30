"""Differences between two configs, key by key, with the place that each value was written at."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from difflib import SequenceMatcher
from typing import Any

from fluxvla_core.config.tree import Config, join_key, leaves


@dataclass(frozen=True)
class Side:
    """One key of one config: its leaf value and ``file:line``."""

    key: str
    value: Any
    where: str


@dataclass(frozen=True)
class Change:
    """A key that one of two configs lacks (its side is None), or that has another value."""

    old: Side | None
    new: Side | None


def differences(old: Config, new: Config) -> list[Change]:
    """The keys that differ between ``old`` and ``new``, in the order of ``new``, then removed ones.

    Values are compared as they are written: ``1`` and ``1.0`` and ``True`` differ, NaN equals NaN.
    Items of lists of tables (transforms) are aligned, so that an inserted one is one change; a key
    then has another number on each side.
    """
    return list(_Compare(old, new).tables(old.tree, new.tree, "", ""))


class _Compare:
    def __init__(self, old: Config, new: Config) -> None:
        self.old, self.new = old, new

    def tables(
        self, old: dict[str, Any], new: dict[str, Any], old_key: str, new_key: str
    ) -> Iterator[Change]:
        for name, value in new.items():
            inner = join_key(new_key, name)
            if name in old:
                yield from self.values(old[name], value, join_key(old_key, name), inner)
            else:
                yield from self.added(value, inner)
        for name, value in old.items():
            if name not in new:
                yield from self.removed(value, join_key(old_key, name))

    def values(self, old: Any, new: Any, old_key: str, new_key: str) -> Iterator[Change]:
        if isinstance(old, dict) and isinstance(new, dict) and old and new:
            yield from self.tables(old, new, old_key, new_key)
        elif isinstance(old, list) and isinstance(new, list) and _nested(old) and _nested(new):
            yield from self.lists(old, new, old_key, new_key)
        elif _text(old) != _text(new):
            if _leaf(old) and _leaf(new):
                yield Change(self._old(old_key, old), self._new(new_key, new))
            else:
                yield from self.removed(old, old_key)
                yield from self.added(new, new_key)

    def lists(self, old: list[Any], new: list[Any], old_key: str, new_key: str) -> Iterator[Change]:
        matcher = SequenceMatcher(None, [_text(v) for v in old], [_text(v) for v in new], False)
        for kind, a, a_end, b, b_end in matcher.get_opcodes():
            if kind == "equal":
                continue
            both = min(a_end - a, b_end - b)
            for i in range(both):
                keys = join_key(old_key, a + i), join_key(new_key, b + i)
                yield from self.values(old[a + i], new[b + i], *keys)
            for i in range(a + both, a_end):
                yield from self.removed(old[i], join_key(old_key, i))
            for i in range(b + both, b_end):
                yield from self.added(new[i], join_key(new_key, i))

    def added(self, value: Any, key: str) -> Iterator[Change]:
        yield from (Change(None, self._new(k, v)) for k, v in leaves(value, key))

    def removed(self, value: Any, key: str) -> Iterator[Change]:
        yield from (Change(self._old(k, v), None) for k, v in leaves(value, key))

    def _old(self, key: str, value: Any) -> Side:
        return Side(key, value, self.old.where(key))

    def _new(self, key: str, value: Any) -> Side:
        return Side(key, value, self.new.where(key))


def _nested(value: list[Any]) -> bool:
    return any(isinstance(item, (dict, list)) for item in value)


def _leaf(value: Any) -> bool:
    """Whether ``leaves`` takes it as one value."""
    return not value or (
        not isinstance(value, dict) and not (isinstance(value, list) and _nested(value))
    )


def _text(value: Any) -> str:
    return json.dumps(value, sort_keys=True)
