"""docs/glossary.md is short, and its classes, functions and keys exist."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest

from fluxvla_core.evaluation.options import EvalOptions
from fluxvla_core.robot.options import InferenceOptions
from fluxvla_core.training.options import TrainOptions
from tests.test_surface import SURFACE

PAGE = (Path(__file__).parents[2] / "docs" / "glossary.md").read_text(encoding="utf-8")
ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in PAGE.splitlines()
    if line.startswith("| ") and not line.startswith("| term |")
]
KEYS = {field.name for options in (EvalOptions, InferenceOptions, TrainOptions)
        for field in dataclasses.fields(options)} | {"type"}  # fmt: skip
PUBLIC = {name for names in SURFACE.values() for name in names}
COMMANDS = (Path(__file__).parents[2] / "src/fluxvla_core/cli/run.py").read_text(encoding="utf-8")


def test_it_is_short_and_every_term_is_there_once() -> None:
    assert 15 <= len(ROWS) <= 25
    assert all(len(row) == 3 and all(row) for row in ROWS)
    assert len({row[0] for row in ROWS}) == len(ROWS)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_what_it_names_exists(row: list[str]) -> None:
    named = re.findall(r"(class|function|key|option) `([^`]+)`", row[2])
    assert len(named) == row[2].count("`") / 2
    for kind, name in named:
        if kind == "option":
            assert f'"{name}"' in COMMANDS, name
        else:
            assert name in (KEYS if kind == "key" else PUBLIC), name
