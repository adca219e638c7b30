"""Every fault of docs/safety.md, provoked while an arm moves over ROS 2, seen from the other side.

What a fault is, and how it is provoked, is in ``benchmarks/_robot_fault_list.py``; ``play`` holds
every command that was received against the limits.
"""

from __future__ import annotations

import pytest

from benchmarks._robot_fault_list import FAULTS
from benchmarks._robot_faults import GOES_ON, REFUSED, STOP, play, stage_crew


@pytest.fixture(scope="module")
def stage(ros_domain):
    with stage_crew() as make:
        yield make


def of(outcome):
    return [pytest.param(f, id=f.name) for f in FAULTS if f.outcome == outcome]


def provoked(stage, folder, fault):
    """A machine that stalls for a quarter of a second stops the arm, rightly, before the fault."""
    for attempt in range(4):
        result = play(stage(folder / str(attempt)), fault)
        if result.provoked:
            return result
    pytest.fail(f"four times the run ended before the fault was there, at last: {result.said}")


def assert_named(fault, result):
    lines = result.said.splitlines()
    assert fault.matches(result.said), f"{result.said!r} does not say {fault.says!r}"
    assert fault.outcome == REFUSED or len(lines) <= 1
    assert result.exit_code == fault.exit_code


@pytest.mark.parametrize("fault", of(REFUSED))
def test_nothing_moves(stage, tmp_path, fault):
    result = play(stage(tmp_path), fault)

    assert_named(fault, result)
    assert len(result.commands) == 0


@pytest.mark.parametrize("fault", of(STOP))
def test_the_arm_is_stopped_and_the_cause_is_named(stage, tmp_path, fault):
    result = provoked(stage, tmp_path, fault)

    assert_named(fault, result)
    assert result.hold_s is not None
    ending = "interrupted" if fault.interrupts else "failed"
    assert (result.record["outcome"], result.record["steps"] >= 20) == (ending, True)
    assert fault.interrupts or result.record["problem"] == result.said
    rules = [trip["rule"] for trip in result.record["trips"]]
    assert rules == ([] if fault.interrupts else [fault.rule])


@pytest.mark.parametrize("fault", of(GOES_ON))
def test_the_run_goes_on(stage, tmp_path, fault):
    result = provoked(stage, tmp_path, fault)

    assert_named(fault, result)
    assert (result.record["outcome"], result.record["trips"]) == ("max_steps", [])
    assert len(result.commands) >= result.record["steps"]
