"""The table of contracts in docs/writing-a-plugin.md says what the code asks for."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import pytest

from fluxvla_core.contracts.methods import (
    FULL_OPERATOR,
    MAY_HAVE,
    NEEDS,
    RANDOM_TRANSFORM,
    TRAIN_RUNNER,
    Methods,
)

ROOT = Path(__file__).parents[2]
CORE = ROOT / "src" / "fluxvla_core"
PAGE = ROOT / "docs" / "writing-a-plugin.md"
CALL = re.compile(r"`(\w+)\(([^)`]*)\)`")
FURTHER: dict[str, Methods] = {
    "runners": TRAIN_RUNNER,
    "transforms": RANDOM_TRANSFORM,
    "operators": FULL_OPERATOR,
}


@dataclass(frozen=True)
class Row:
    must: list[tuple[str, int]]  # method, number of arguments
    may: list[tuple[str, int]]
    files: list[str]


def rows() -> dict[str, Row]:
    found: dict[str, Row] = {}
    text = PAGE.read_text(encoding="utf-8").partition("## What each contract asks for")[2]
    for line in text.partition("\n## ")[0].splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        for registry in re.findall(r"`fluxvla\.(\w+)`", cells[1]) if len(cells) == 5 else ():
            assert registry not in found
            found[registry] = Row(calls(cells[2]), calls(cells[3]), re.findall("`(.+?)`", cells[4]))
    return found


def calls(cell: str) -> list[tuple[str, int]]:
    return [(name, len([a for a in given.split(",") if a])) for name, given in CALL.findall(cell)]


def fixed(sets: tuple[Methods, ...]) -> set[tuple[str, int]]:
    """The methods that are given a number of positional arguments."""
    return {(m, n) for one in sets for m, n in one.items() if isinstance(n, int)}


def names(sets: tuple[Methods, ...]) -> set[str]:
    return {method for one in sets for method in one}


def test_every_registry_has_a_row() -> None:
    assert set(rows()) == set(NEEDS)


@pytest.mark.parametrize("registry", NEEDS)
def test_a_row_names_what_is_asked_for(registry: str) -> None:
    row = rows()[registry]
    needs = (*NEEDS[registry], FURTHER.get(registry, {}))
    assert {name for name, _ in row.must} == names(needs)
    assert fixed(needs) <= set(row.must)
    if registry != "operators":  # they have a table of their own
        may = (MAY_HAVE.get(registry, {}),)
        assert {name for name, _ in row.may} == names(may) - names(needs)
        assert fixed(may) <= {*row.may, *row.must}


@pytest.mark.parametrize("registry", NEEDS)
def test_the_files_of_a_row_are_those_that_call(registry: str) -> None:
    row = rows()[registry]
    text = ""
    for name in row.files:
        path = CORE / name
        files = sorted(path.glob("*.py")) if path.is_dir() else [path]
        text += "".join(file.read_text(encoding="utf-8") for file in files)
    named = {name for name, _ in (*row.must, *row.may) if not name.startswith("__")}
    assert {name for name in named if name not in text} == set()


def test_links_lead_to_the_headings_that_they_name() -> None:
    links = re.findall(r"\]\((\w*(?:\.md)?)#([\w-]+)\)", PAGE.read_text(encoding="utf-8"))
    assert ("training.md", "a-strategy-of-your-own") in links
    for page, anchor in links:
        text = (PAGE.parent / (page or PAGE.name)).read_text(encoding="utf-8")
        titles = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
        assert anchor in [title.lower().replace(" ", "-") for title in titles]
