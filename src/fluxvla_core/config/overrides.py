"""``--set key=value``: the command line's changes to a config, and hints that suggest one."""

from __future__ import annotations

import copy
import re
import shlex
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from fluxvla_core.config.resolve import INJECTED, table_signature
from fluxvla_core.config.similar_keys import similar_key, unit_note
from fluxvla_core.config.tree import (
    NO_TEXT,
    Config,
    all_keys,
    is_text,
    is_within,
    join_key,
    parent_key,
    plain,
    split_key,
)
from fluxvla_core.errors import ConfigError, FluxError, Problem, nearest

_PYTHON = {"True": True, "False": False, "None": None}
_SPLIT = re.compile(r"\s*(\+?)=\s*")


def apply_overrides(config: Config, overrides: Iterable[str]) -> Config:
    """``config`` with each ``key=value`` set, in order.

    ``key`` is dotted, with list indices (``transforms.0.height``) and ``\\.`` for a dot in a name.
    It is in the config, or the class of its table takes it; ``key+=value`` appends to a list, or
    adds a key that no class is known to take. A value is TOML (numbers, ``true``, ``"text"``,
    ``[1, 2]``, ``{type = "X"}``), Python's ``True``, ``False`` and ``None``, or else a bare word
    or sentence taken as it is. A table replaces the one that is there.

    Raises:
        ConfigError: all that do not fit, with a did-you-mean.
    """
    tree, origins = copy.deepcopy(config.tree), dict(config.origins)
    problems: list[Problem] = []
    for text in overrides:
        place = f"--set {text}"
        try:
            key, add, value = _parse(text)
            written = _put(tree, key, value, add, text)
        except _BadOverride as bad:
            problems.append(Problem(place, "", str(bad)))
            continue
        for key in written:
            for old in [k for k in origins if is_within(k, key)]:
                del origins[old]
            origins[key] = place
    if problems:
        raise ConfigError.from_problems(tuple(problems))
    return replace(config, tree=tree, origins=origins)


class _BadOverride(Exception):
    pass


def _parse(text: str) -> tuple[str, bool, Any]:
    match = _SPLIT.search(text)
    if match is None or not text[: match.start()].strip():
        raise _BadOverride("an override is key=value, or key+=value to add")
    return text[: match.start()].strip(), bool(match[1]), parse_value(text[match.end() :])


def parse_value(text: str) -> Any:
    """The value that ``text`` means; see :func:`apply_overrides`."""
    import tomli

    text = text.strip()
    if not is_text(text):
        raise _BadOverride(NO_TEXT)
    if text in _PYTHON:
        return _PYTHON[text]
    if "\n" in text:
        return text
    try:
        value = tomli.loads(f"value = {text}")["value"]
    except tomli.TOMLDecodeError as error:
        if text[:1] in {"[", "{", '"', "'"}:
            raise _BadOverride(f"{text!r} is not a TOML value: {error.msg}") from error
        number = _number(text)
        if number is not None:
            raise _BadOverride(
                f"{text!r} is not a TOML number; write it as {number}, or '\"{text}\"' for text"
            ) from error
        return text
    except (ValueError, RecursionError) as error:
        raise _BadOverride(
            "the value is nested too deeply, or a number of thousands of digits"
        ) from error
    found: list[tuple[str, str]] = []
    data = plain(value, "", found)
    return text if found else data  # TOML's dates and times stay text


def _number(text: str) -> float | int | None:
    """``text`` as a number if Python reads it as one, else None."""
    try:
        number = float(text)
    except ValueError:
        return None
    return int(number) if number.is_integer() else number


def _put(tree: dict[str, Any], key: str, value: Any, add: bool, text: str) -> list[str]:
    """Set ``key`` in ``tree``; returns the keys of the new values. ``text`` is for messages."""
    *above, last = split_key(key)
    at: Any = tree
    done = ""
    for depth, part in enumerate(above):
        at = _step(tree, at, above[:depth], part, key, text)
        done = join_key(done, part)
    if isinstance(at, list):
        index = _index(at, last, key)
        at[index], written = _added(at[index], value, key) if add else (value, [key])
        return written
    if not isinstance(at, dict):
        raise _BadOverride(f"{done!r} is a single value, it has no {last!r}")
    if last not in at and not add:
        _check_taken(at, above, last, key, text)
    if last not in at or not add:
        at[last] = value
        return [key]
    at[last], written = _added(at[last], value, key)
    return written


def _added(old: Any, value: Any, key: str) -> tuple[Any, list[str]]:
    """``value`` added to the value of ``key``, and the keys of the new values."""
    if isinstance(old, list):
        more = value if isinstance(value, list) else [value]
        return [*old, *more], [join_key(key, len(old) + i) for i in range(len(more))]
    if isinstance(old, dict) and isinstance(value, dict):
        return {**old, **value}, [join_key(key, name) for name in value]
    raise _BadOverride(f"it is there already, as {old!r}; += adds a key or appends, = replaces")


def _step(tree: dict[str, Any], at: Any, path: list[str], part: str, key: str, text: str) -> Any:
    if isinstance(at, list):
        return at[_index(at, part, key)]
    if isinstance(at, dict) and part in at:
        return at[part]
    signature = table_signature(path, at) if isinstance(at, dict) else None
    if signature is not None and part in signature.names:
        whole = ".".join(split_key(key)[: len(path) + 1])
        inner = key[len(whole) + 1 :]
        raise _BadOverride(
            f"no {whole!r} in the config yet: give the whole table, "
            f"--set '{whole}={{{inner} = ...}}'"
        )
    near = nearest(key, all_keys(tree), 0.75)
    hint = _meant(text, near) if near else ""
    raise _BadOverride(f"no {key!r} in the config{hint}")


def _index(at: list[Any], part: str, key: str) -> int:
    if not (part.isascii() and part.isdigit() and len(part) <= 9):
        raise _BadOverride(f"{key!r}: {part!r} must be a number, it counts items of a list from 0")
    if int(part) >= len(at):
        raise _BadOverride(f"{key!r}: there is no item {part}, the list has {len(at)}")
    return int(part)


def _check_taken(table: dict[str, Any], above: list[str], name: str, key: str, text: str) -> None:
    """Refuse a new ``name`` in ``table``, unless its class is known to take it."""
    signature = table_signature(above, table)
    missing, adding = f"no {key!r} in the config", f" [to add it: {_as_set(text, key, '+=')}]"
    takes = {n for n in signature.names if n not in INJECTED} if signature is not None else set()
    if name in takes:
        return
    near = similar_key(name, {*takes, *table})
    hint = _meant(text, join_key(parent_key(key), near), unit_note(name, near)) if near else ""
    if signature is not None and not signature.open:
        missing, adding = f"{missing}, and {signature.name} takes no {name!r}", ""
    raise _BadOverride(missing + hint + adding)


def _meant(text: str, key: str, unit: str = "") -> str:
    """The key that was meant: with the value given, or with ``unit`` where that is another one."""
    if unit:
        return f"; did you mean --set {key}=… ({unit})?"
    return f"; did you mean {_as_set(text, key, '=')}?"


def _as_set(text: str, key: str, sign: str) -> str:
    """The override ``text`` for another key, quoted for a shell."""
    match = _SPLIT.search(text)
    assert match is not None  # it was parsed
    return f"--set {shlex.quote(f'{key}{sign}{text[match.end() :]}')}"


# -- hints ---------------------------------------------------------------------------------------

# A class does not know where in a config its table stands. Its hint says
# ``--set <ClassName>.KEY=VALUE``, or ``--set <section>.KEY=VALUE`` for the section that runs, and
# the code that has the config puts the table's own key there.
_TABLE = re.compile(r"(--set '?)<(\w+)>\.")
_SECTION = "section"


@contextmanager
def complete_hints(config: Mapping[str, Any], section: str = "") -> Iterator[None]:
    """Complete the hint of an error that is raised inside.

    Args:
        section: the section that runs; its tables go before those of others.
    """
    try:
        yield
    except FluxError as error:
        if error.next:
            error.next = complete(error.next, config, section)
        raise


def complete(hint: str, config: Mapping[str, Any], section: str = "") -> str:
    """``hint`` with the keys of tables for ``<ClassName>``.

    The keys of several tables of the class are listed after it; with none (the table is in a
    checkpoint) the hint stays.
    """
    notes: dict[str, str] = {}

    def key(match: re.Match[str]) -> str:
        name = match[2]
        if name == _SECTION:
            return f"{match[1]}{section}." if section else match[0]
        here = list(_tables(config.get(section), name, section)) if section else []
        found = here or list(_tables(config, name, ""))
        if len(found) == 1:
            return f"{match[1]}{found[0]}."
        if found:
            notes[name] = f" (<{name}> is {' or '.join(found)})"
        return match[0]

    return _TABLE.sub(key, hint) + "".join(notes.values())


def _tables(tree: Any, name: str, key: str) -> Iterator[str]:
    """Keys of the tables with ``type`` ``name`` or ``distribution:name``."""
    if isinstance(tree, Mapping):
        if str(tree.get("type")).rpartition(":")[2] == name:
            yield key
        items = list(tree.items())
    elif isinstance(tree, list | tuple):
        items = list(enumerate(tree))
    else:
        return
    for inner, value in items:
        yield from _tables(value, name, join_key(key, inner))
