"""docs/safety.md says what was measured, of every fault there is, and names tests that exist."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from benchmarks.time_to_hold import ALL, NO_HOLD, shown
from fluxvla_core.operators import SafetySettings

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks" / "results" / "time_to_hold.json"
TEST = re.compile(r"`((?:tests/(?:\w+/)+)?test_\w+\.py)(?:::(\w+))?`")


@pytest.fixture(scope="module")
def page():
    return (ROOT / "docs" / "safety.md").read_text(encoding="utf-8")


def table(page, first):
    """The cells of the table whose first column is called ``first``, row by row."""
    _, _, below = page.partition(f"| {first} |")
    lines = below.partition("\n\n")[0].splitlines()[2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


@pytest.fixture(scope="module")
def rows(page):
    return table(page, "fault")


def test_the_thresholds_are_listed_with_their_defaults(page):
    listed = {}
    for keys, values, _ in table(page, "key"):
        numbers = [float(number) for number in re.findall(r"[\d.]+", values)]
        names = re.findall(r"`(\w+)`", keys)
        listed |= zip(names, numbers * len(names) if len(numbers) == 1 else numbers, strict=True)
    assert listed == vars(SafetySettings())


def test_every_test_that_the_page_names_exists(page):
    named = TEST.findall(page)

    assert len(named) > 30
    for file, test in named:
        path = ROOT / file if "/" in file else ROOT / "tests" / "robot" / file
        assert path.exists(), file
        assert f"def {test}(" in path.read_text(encoding="utf-8") if test else True, test


def test_the_table_has_the_faults_that_are_provoked_and_nothing_blank(rows):
    assert [row[0] for row in rows] == [fault.name for fault in ALL]
    for row in rows:
        assert len(row) == 5
        assert all(row), row
        assert TEST.fullmatch(row[4]), row


def test_the_times_are_those_that_were_measured(rows):
    measured = json.loads(RESULTS.read_text(encoding="utf-8"))["faults"]

    assert [row[0] for row in rows] == list(measured)
    for name, _, _, said, _ in rows:
        assert said == shown(measured[name]), name


def test_a_fault_after_which_nothing_is_sent_is_not_held_in_no_time(rows):
    assert shown({"outcome": "stop", "max_s": 0.0}) == NO_HOLD
    assert shown({"outcome": "stop", "max_s": 0.04}) == "0.04 s"
    assert not any(row[3] == "0.00 s" for row in rows)
    killed = "two processes: both killed (SIGKILL)"
    assert [row[3] for row in rows if row[0] == killed] == [NO_HOLD]
