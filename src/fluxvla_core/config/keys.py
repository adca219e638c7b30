"""Dotted keys: ``runner.collator.keys.0``; a dot inside a part is written ``\\.``."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

_DOT = re.compile(r"(?<!\\)\.")


def split(key: str) -> list[str]:
    """``r"stats.observation\\.state"`` -> ``["stats", "observation.state"]``."""
    return [part.replace(r"\.", ".") for part in _DOT.split(key)]


def child(parent: str, part: str | int) -> str:
    """The key of ``part`` inside ``parent`` (``""`` is the root)."""
    text = str(part).replace(".", r"\.")
    return f"{parent}.{text}" if parent else text


def parent(key: str) -> str:
    """The key of the table or list that holds ``key``; ``""`` for a top-level one."""
    matches = list(_DOT.finditer(key))
    return key[: matches[-1].start()] if matches else ""


def within(key: str, table: str) -> bool:
    """Whether ``key`` is ``table`` or lies in it."""
    return key == table or key.startswith(f"{table}.")


def leaves(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Every (key, scalar) below ``value``; empty tables and lists count as leaves."""
    if isinstance(value, dict) and value:
        for name, item in value.items():
            yield from leaves(item, child(key, name))
    elif isinstance(value, list) and value and any(isinstance(v, (dict, list)) for v in value):
        for index, item in enumerate(value):
            yield from leaves(item, child(key, index))
    elif key:
        yield key, value


def every(value: Any, key: str = "") -> Iterator[str]:
    """The keys of everything at and below ``value``, tables and lists included."""
    if key:
        yield key
    if isinstance(value, dict):
        for name, item in value.items():
            yield from every(item, child(key, name))
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from every(item, child(key, index))
