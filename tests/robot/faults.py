"""What tests of faults share: spoiled chunks, and checks of how a robot was stopped."""

from __future__ import annotations

import re

import numpy as np
import pytest


def nan(chunk):
    chunk[0, 0] = np.nan
    return chunk


def spoil(row: int, column: int, value: float):
    def change(chunk):
        chunk[row, column] = value
        return chunk

    return change


def fails(bench, kind, match, **arguments):
    with pytest.raises(kind, match=match) as caught:
        bench.run(**arguments)
    return caught.value


def seconds(said, what: str) -> float:
    """The seconds that follow ``what`` in an error: as many as the machine adds."""
    found = re.search(rf"{what} (\d+\.\d+) s", str(said))
    assert found, f"{said} does not say for how long: {what}"
    return float(found[1])


def assert_stopped(bench, rule: str, text: str) -> None:
    """The robot was stopped and given back, and the record says why."""
    assert bench.arm.calls[0] == "connect"
    assert bench.arm.calls[1:] == ["stop", "stop", "close"]
    summary = bench.episode()
    assert summary["outcome"] == "failed"
    assert text in summary["problem"]
    assert [(trip["rule"], trip["what"]) for trip in summary["trips"]] == [
        (rule, summary["problem"])
    ]
    (stop,) = [row for row in bench.trace() if row["event"] == "stop"]
    assert stop["rule"] == rule
    if rule != "tracking":
        bench.assert_within_limits()
        return
    rows = [row for row in bench.trace() if row["event"] == "command"]
    before = [np.array(row["command"]) for row in rows if row["phase"] == "run"]
    after = [np.array(row["command"]) for row in rows if row["phase"] == "stop"]
    # What blocks it is not pushed on; it is let go within the limits, and nothing more is sent.
    assert (np.diff([before[-1][0], *(row[0] for row in after)]) <= 0).all()
    np.testing.assert_array_equal(after[-1], bench.arm.state)
    assert len(bench.arm.sent) == len(before) + len(after)
    bench.assert_within_limits(sent=before)
    bench.assert_within_limits(tuple(before[-1]), after)


def assert_braked(bench) -> None:
    """The last commands slow down to a hold within the acceleration limit.

    In the stop, or before: an arm that a late policy let rest has nothing to slow down.
    """
    bench.assert_within_limits()
    np.testing.assert_array_equal(bench.arm.sent[-1], bench.arm.sent[-2])
