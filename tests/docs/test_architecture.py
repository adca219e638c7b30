"""docs/architecture.md names modules, functions and packages that exist."""

from __future__ import annotations

import importlib
import re
from functools import reduce
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CORE = ROOT / "src" / "fluxvla_core"
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
ENTRY = re.compile(r"^- `(fluxvla_\w+[\w.]*):([\w.]+)` – (.+)$", re.MULTILINE)
ENTRIES = ENTRY.findall(PAGE)
LISTS = {
    title: ENTRY.findall(text)
    for title, _, text in (part.partition("\n") for part in re.split(r"\n##+ ", PAGE)[1:])
}
MOST = {
    "How a plugin is loaded": 8,
    "From the config to the first training step": 22,
    "From a training step to a checkpoint, and resuming": 12,
    "From a frame to a command": 10,
    "From an evaluation episode to the report": 8,
}
"""A list -> how many modules a reader of it has to open at most."""


def test_every_item_of_a_list_is_an_entry() -> None:
    assert len(re.findall(r"^- ", PAGE, re.MULTILINE)) == len(ENTRIES)


@pytest.mark.parametrize("title", MOST)
def test_the_main_paths_are_listed_and_short(title: str) -> None:
    assert len(LISTS[title]) >= 5
    assert len({module for module, _, _ in LISTS[title]}) <= MOST[title]


@pytest.mark.parametrize(("module", "name"), [(m, n) for m, n, _ in ENTRIES])
def test_an_entry_can_be_imported(module: str, name: str) -> None:
    found = reduce(getattr, name.split("."), importlib.import_module(module))
    assert callable(found)
    # An alias or a re-export would send the reader to another file.
    assert found.__module__ == module


def test_the_table_of_packages_is_complete() -> None:
    section = PAGE.partition("## Packages")[2].partition("\n## ")[0]
    listed = re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE)
    there = {p.parent.name for p in CORE.glob("*/__init__.py")}
    there |= {p.stem for p in CORE.glob("*.py") if not p.stem.startswith("_")}
    assert sorted(listed) == sorted(there)
