"""docs/safety.md says what was measured, of every fault there is, and names tests that exist."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from benchmarks._robot_fault_list import FAULTS

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks" / "results" / "time_to_hold.json"
TEST = re.compile(r"`((?:tests/\w+/)?test_\w+\.py)(?:::(\w+))?`")


@pytest.fixture(scope="module")
def page():
    return (ROOT / "docs" / "safety.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def rows(page):
    lines = [line for line in page.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[1:]]


def test_every_test_that_the_page_names_exists(page):
    named = TEST.findall(page)

    assert len(named) > 30
    for file, test in named:
        path = ROOT / file if "/" in file else ROOT / "tests" / "robot" / file
        assert path.exists(), file
        assert f"def {test}(" in path.read_text(encoding="utf-8") if test else True, test


def test_the_table_has_the_faults_that_are_provoked_and_nothing_blank(rows):
    assert [row[0] for row in rows] == [fault.name for fault in FAULTS]
    for row in rows:
        assert len(row) == 5
        assert all(row), row
        assert TEST.fullmatch(row[4]), row


def test_the_times_are_those_that_were_measured(rows):
    measured = json.loads(RESULTS.read_text(encoding="utf-8"))["faults"]

    assert [row[0] for row in rows] == list(measured)
    for name, _, _, said, _ in rows:
        found = measured[name]
        wanted = {"refused": "nothing moves", "goes on": "goes on"}.get(found["outcome"])
        assert said == (wanted or f"{found['median_s']:.2f} s"), name
