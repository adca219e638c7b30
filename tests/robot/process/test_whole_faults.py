"""What goes wrong with a robot whose operator runs as a whole in the control process.

What a fault is, and how it is provoked, is in ``benchmarks/_whole_faults.py``; every command that
the arm received is held against the limits, and no process is left.
"""

from __future__ import annotations

import pytest

from benchmarks._robot_faults import ARM
from benchmarks._whole_faults import PREFIX, WHOLE_FAULTS, play

pytestmark = pytest.mark.realtime
# What is allowed before something counts as a fault, by rule; a policy's until memory is used up.
ALLOWED_S = {"freshness": 0.5, "main process": 0.2, "policy": 0.3}
# Some ticks until a command says so, and braking from full speed: 2 rad/s at 10 rad/s².
BRAKING_S = 0.3
# A machine that runs tests may stand still meanwhile; it makes a stop later, of no more commands.
STALL_S = 1.5


def provoked(folder, fault):
    """A machine that stalls for a fifth of a second stops the arm, rightly, before the fault."""
    for attempt in range(4):
        result = play(folder / str(attempt), fault)
        if result.provoked:
            return result
    pytest.fail(f"four times the run ended before the fault was there, at last: {result.said}")


@pytest.mark.parametrize(
    "fault", [pytest.param(fault, id=fault.name.removeprefix(PREFIX)) for fault in WHOLE_FAULTS]
)
def test_the_arm_is_stopped_and_the_cause_is_named(tmp_path, fault):
    result = provoked(tmp_path, fault)

    assert fault.matches(result.said), f"{result.said!r} does not say {fault.says!r}"
    assert result.exit_code == fault.exit_code
    assert result.hold_s is not None
    allowed_s = ALLOWED_S.get(fault.rule, 0.0) + BRAKING_S
    assert result.late <= allowed_s * ARM.rate_hz
    assert result.hold_s <= allowed_s + STALL_S
    if fault.exit_code < 0:
        # The control process may complete a record, of whatever it knows.
        return
    assert result.record["outcome"] == ("interrupted" if fault.interrupts else "failed")
    rules = [trip["rule"] for trip in result.record["trips"]]
    assert rules == ([] if fault.interrupts else [fault.rule])
    assert fault.interrupts or result.record["problem"].strip() in result.said
