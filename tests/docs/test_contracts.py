"""The table of contracts in docs/writing-a-plugin.md says what the code asks for."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import pytest

from fluxvla_core import RandomTransform, TrainRunner
from fluxvla_core.contracts.check import Arguments, contract_of, methods, needs
from fluxvla_core.contracts.contract import abstract_methods
from fluxvla_core.registries import REGISTRIES, ROWS

ROOT = Path(__file__).parents[2]
CORE = ROOT / "src" / "fluxvla_core"
PAGE = ROOT / "docs" / "writing-a-plugin.md"
CALL = re.compile(r"`(\w+)\(([^)`]*)\)`")
FURTHER = {"runners": TrainRunner, "transforms": RandomTransform}
"""Contracts of classes that say that they are of another kind."""


@dataclass(frozen=True)
class Row:
    about: str
    must: list[tuple[str, int]]  # method, number of arguments
    may: list[tuple[str, int]]
    files: list[str]


def rows() -> dict[str, Row]:
    found: dict[str, Row] = {}
    text = PAGE.read_text(encoding="utf-8").partition("## Contract reference")[2]
    for line in text.partition("\n## ")[0].splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        for registry in re.findall(r"`fluxvla\.(\w+)`", cells[1]) if len(cells) == 5 else ():
            assert registry not in found
            found[registry] = Row(
                cells[0], calls(cells[2]), calls(cells[3]), re.findall("`(.+?)`", cells[4])
            )
    return found


def calls(cell: str) -> list[tuple[str, int]]:
    return [(name, len([a for a in given.split(",") if a])) for name, given in CALL.findall(cell)]


def required(registry: str) -> set[tuple[str, Arguments]]:
    """Every method that some class must have, of all alternatives, and what it is given."""
    found: set[tuple[str, Arguments]] = set()
    for contract in {contract_of(registry), FURTHER.get(registry, contract_of(registry))}:
        every = methods(contract)
        found |= {(name, every[name]) for name in abstract_methods(contract)}
        for one in needs(contract, object):
            found |= set(one.items())
    return found


def optional(registry: str) -> set[tuple[str, Arguments]]:
    """Every other method that the core calls."""
    must = {name for name, _ in required(registry)}
    every = methods(contract_of(registry)).items()
    return {(m, n) for m, n in every if m not in must and not m.startswith("__")}


def fixed(named: set[tuple[str, Arguments]]) -> set[tuple[str, Arguments]]:
    """The methods that are given a number of positional arguments."""
    return {(m, n) for m, n in named if isinstance(n, int)}


def names(named: Iterable[tuple[str, object]]) -> set[str]:
    return {name for name, _ in named}


def test_the_table_is_that_of_the_registries() -> None:
    assert {name: row.about for name, row in rows().items()} == {r.name: r.about for r in ROWS}


@pytest.mark.parametrize("registry", REGISTRIES)
def test_a_row_names_what_is_asked_for(registry: str) -> None:
    row = rows()[registry]
    assert names(row.must) == names(required(registry))
    assert fixed(required(registry)) <= set(row.must)
    if registry != "operators":  # they have a table of their own
        assert names(row.may) == names(optional(registry))
        assert fixed(optional(registry)) <= set(row.may)


@pytest.mark.parametrize("name", sorted(names(optional("operators"))))
def test_what_an_operator_may_have_besides_is_named(name: str) -> None:
    text = PAGE.read_text(encoding="utf-8").partition("### Optional operator methods")[2]
    assert f"`{name}()`" in text


@pytest.mark.parametrize("registry", REGISTRIES)
def test_the_files_of_a_row_are_those_that_call(registry: str) -> None:
    row = rows()[registry]
    text = ""
    for name in row.files:
        path = CORE / name
        files = sorted(path.glob("*.py")) if path.is_dir() else [path]
        text += "".join(file.read_text(encoding="utf-8") for file in files)
    named = {name for name, _ in (*row.must, *row.may) if not name.startswith("__")}
    assert {name for name in named if name not in text} == set()
