"""A config as data: one plain tree, its dotted keys, and the source position of each.

Dotted keys are like ``runner.collator.keys.0``; a dot inside a part is written ``\\.``.
"""

from __future__ import annotations

import copy
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any, NoReturn

from fluxvla_core.errors import ConfigError, Problem

DELETE = "_delete_"
NO_TEXT = "half of a surrogate pair is not text, no file can hold it"
_DOT = re.compile(r"(?<!\\)\.")


@dataclass(frozen=True)
class Config:
    """One config.

    Args:
        tree: tables (dict), lists and scalars (str, int, float, bool, None); nothing else, so
            that a run and the ``config.resolved.json`` that it wrote build the same objects.
        origins: dotted key -> ``file:line`` (or the ``--set`` that put it there).
        file: the file that was loaded, as messages show it.
        left_over: inherited keys of tables whose ``type`` an inheriting file changed: they were
            written for another class.
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
            key = parent_key(key)
        return self.file

    def problem(self, key: str, what: str) -> Problem:
        return Problem(self.where(key), key, what)


def shown(path: Path) -> str:
    """``path`` for messages: relative to the current directory if it is inside."""
    try:
        # realpath takes a link that leads to itself as it is; resolve() raises.
        return str(Path(os.path.realpath(path)).relative_to(os.path.realpath(Path.cwd())))
    except (ValueError, OSError):
        return str(path)


def plain(value: Any, key: str, problems: list[tuple[str, str]]) -> Any:
    """A copy of ``value`` in plain data: tuples become lists, paths strings.

    Other objects are left out and appended to ``problems`` as (key, finding).
    """
    if isinstance(value, str):
        return _text(value, key, problems)
    if value is None or isinstance(value, (bool, int, float)):
        return value
    if isinstance(value, PurePath):
        return str(value)
    if isinstance(value, (list, tuple)):
        return [plain(item, join_key(key, i), problems) for i, item in enumerate(value)]
    if isinstance(value, Mapping):
        out = {}
        for name, item in value.items():
            if not isinstance(name, str):
                problems.append((key, f"a key must be a string: write {str(name)!r}, not {name!r}"))
                continue
            out[_text(name, key, problems)] = plain(item, join_key(key, name), problems)
        return out
    if isinstance(value, type) and split_key(key)[-1:] == ["type"]:
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


def _text(text: str, key: str, problems: list[tuple[str, str]]) -> str:
    if not is_text(text):
        problems.append((key, NO_TEXT))
    return text


def is_text(text: str) -> bool:
    """Whether it can be encoded: halves of surrogate pairs, from JSON's escapes or a command line
    that is not UTF-8, cannot."""
    return text.isascii() or not any("\ud800" <= letter <= "\udfff" for letter in text)


def strip(value: Any) -> Any:
    """``value`` without ``_delete_`` marks, for tables that inherit nothing."""
    if isinstance(value, dict):
        return {k: strip(v) for k, v in value.items() if k != DELETE}
    if isinstance(value, list):
        return [strip(item) for item in value]
    return value


# -- dotted keys -------------------------------------------------------------------------------


def split_key(key: str) -> list[str]:
    """``r"stats.observation\\.state"`` -> ``["stats", "observation.state"]``."""
    return [part.replace(r"\.", ".") for part in _DOT.split(key)]


def join_key(table: str, part: str | int) -> str:
    """The key of ``part`` inside ``table`` (``""`` is the root)."""
    text = str(part).replace(".", r"\.")
    return f"{table}.{text}" if table else text


def parent_key(key: str) -> str:
    """The key of the table or list that holds ``key``; ``""`` for a top-level one."""
    matches = list(_DOT.finditer(key))
    return key[: matches[-1].start()] if matches else ""


def is_within(key: str, table: str) -> bool:
    """Whether ``key`` is ``table`` or lies in it."""
    return key == table or key.startswith(f"{table}.")


def leaves(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Every (key, scalar) below ``value``; empty tables and lists count as leaves."""
    if isinstance(value, dict) and value:
        for name, item in value.items():
            yield from leaves(item, join_key(key, name))
    elif isinstance(value, list) and value and any(isinstance(v, (dict, list)) for v in value):
        for index, item in enumerate(value):
            yield from leaves(item, join_key(key, index))
    elif key:
        yield key, value


def all_keys(value: Any, key: str = "") -> Iterator[str]:
    """The keys of everything at and below ``value``, tables and lists included."""
    if key:
        yield key
    if isinstance(value, dict):
        for name, item in value.items():
            yield from all_keys(item, join_key(key, name))
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from all_keys(item, join_key(key, index))


# -- inheritance: tables merge key by key, everything else, lists too, replaces ----------------


def merge(base: Config, over: Config) -> Config:
    """``over`` on top of ``base``; every key keeps the place that its value was written at.

    ``_delete_ = True`` in a table of ``over`` replaces the inherited table instead of merging
    into it; alone in a table it removes the key. ``None`` may replace a table and be replaced by
    one (that is how an option is switched off and on).

    Raises:
        ConfigError: a table meets a scalar or a list, or ``_delete_`` is not boolean; all at once.
    """
    tree, origins, left_over = copy.deepcopy(base.tree), dict(base.origins), set(base.left_over)
    problems: list[Problem] = []

    def put(into: dict[str, Any], name: str, value: Any, key: str) -> None:
        for old in [k for k in origins if is_within(k, key)]:
            del origins[old]
        for new, place in over.origins.items():
            if is_within(new, key):
                origins[new] = place
        left_over.difference_update([k for k in left_over if is_within(k, key)])
        left_over.update(k for k in over.left_over if is_within(k, key))
        into[name] = strip(copy.deepcopy(value))

    def walk(into: dict[str, Any], new: dict[str, Any], at: str) -> None:
        if _another_type(into, new):
            left_over.update(join_key(at, name) for name in into.keys() - new.keys())
        for name, value in new.items():
            if name == DELETE:
                continue
            key = join_key(at, name)
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

    A key that both inherit from one common base (same place) is not a conflict.

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
    """Whether one of them is a table and the other a value other than None."""
    return isinstance(old, dict) != isinstance(new, dict) and old is not None and new is not None


def _values(table: dict[str, Any], at: str = "") -> Iterator[str]:
    """Keys of everything but tables; merging replaces these values."""
    for name, value in table.items():
        key = join_key(at, name)
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


# -- read-only copies --------------------------------------------------------------------------


def freeze(value: Any) -> Any:
    """A read-only copy of a plain tree: a change by one object would reach the next one.

    Dicts and lists that refuse to change: still ``dict`` and ``list`` for ``isinstance``, ``json``
    and ``**``. Copies (``dict(x)``, ``x.copy()``, ``copy.deepcopy``, pickles) can be changed.
    """
    if isinstance(value, dict):
        return FrozenDict({k: freeze(v) for k, v in value.items()})
    if isinstance(value, (list, tuple)):
        return FrozenList(freeze(v) for v in value)
    return value


def thaw(value: Any) -> Any:
    """An ordinary copy of a plain tree."""
    if isinstance(value, dict):
        return {k: thaw(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [thaw(v) for v in value]
    return value


def _refuse(self: Any, *args: Any, **kwargs: Any) -> NoReturn:
    raise TypeError(
        "the config is read-only: what one object changed, the next would be built from; "
        "work on a copy (copy.deepcopy(...))"
    )


class FrozenDict(dict[str, Any]):
    __setitem__ = __delitem__ = update = setdefault = pop = popitem = clear = _refuse
    __ior__ = _refuse

    def copy(self) -> dict[str, Any]:
        return dict(self)

    def __deepcopy__(self, memo: dict[int, Any]) -> dict[str, Any]:
        return {k: copy.deepcopy(v, memo) for k, v in self.items()}

    def __reduce__(self) -> tuple[Any, ...]:
        return (dict, (thaw(self),))


class FrozenList(list[Any]):
    __setitem__ = __delitem__ = append = extend = insert = pop = remove = _refuse
    clear = sort = reverse = __iadd__ = __imul__ = _refuse

    def copy(self) -> list[Any]:
        return list(self)

    def __deepcopy__(self, memo: dict[int, Any]) -> list[Any]:
        return [copy.deepcopy(v, memo) for v in self]

    def __reduce__(self) -> tuple[Any, ...]:
        return (list, (thaw(self),))
