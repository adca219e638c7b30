"""Hints that name a config key, as whole options.

A class does not know where in a config its table stands. Its hint says
``--set <ClassName>.KEY=VALUE``, or ``--set <section>.KEY=VALUE`` for the section that runs, and
the code that has the config puts the table's own key there.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from fluxvla_core.config.tree import join_key
from fluxvla_core.errors import FluxError

_TABLE = re.compile(r"(--set '?)<(\w+)>\.")
_SECTION = "section"


@contextmanager
def whole_options(config: Mapping[str, Any], section: str = "") -> Iterator[None]:
    """Complete the hint of an error of FluxVLA that passes.

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
    """``hint`` with the keys of tables; several of one class are listed after it, one with none
    (its table is in a checkpoint) stays."""
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
    """Keys of the tables of class ``name``; ``<distribution>:<name>`` is one, too."""
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
