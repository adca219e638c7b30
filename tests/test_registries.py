"""Everything that follows from the table of registries."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import fluxvla_core
from fluxvla_core import build
from fluxvla_core.contracts.check import contract_of
from fluxvla_core.plugins import registry
from fluxvla_core.registries import BY_NAME, GROUPS, REGISTRIES, ROWS

SRC = Path(fluxvla_core.__file__).parent


def declared(file: str) -> list[str]:
    """The names that a module declares for type checkers alone."""
    tree = ast.parse((SRC / file).read_text(encoding="utf-8"))
    (block,) = [
        node
        for node in tree.body
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING" and node.orelse
    ]
    return [ast.unparse(node.target) for node in block.body if isinstance(node, ast.AnnAssign)]


def test_the_names_in_code_are_those_of_the_table():
    assert declared("plugins/registry.py") == [row.constant for row in ROWS]
    assert declared("build.py") == [row.builder for row in ROWS if row.builder]


@pytest.mark.parametrize("row", ROWS, ids=REGISTRIES)
def test_a_row_is_all_that_a_registry_needs(row):
    there = getattr(fluxvla_core, row.constant)
    assert there is registry.BY_NAME[row.name]
    assert there.group == row.group == f"fluxvla.{row.name}"
    assert BY_NAME[row.name] is row
    assert row.group in GROUPS
    assert contract_of(row.name)
    if row.builder:
        assert getattr(fluxvla_core, row.builder) is getattr(build, row.builder)
        assert getattr(build, row.builder).__name__ == row.builder
        assert {row.constant, row.builder} <= set(fluxvla_core.__all__)
