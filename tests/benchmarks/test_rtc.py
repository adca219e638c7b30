"""What the benchmark of real-time chunking makes of an episode's record."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("fluxvla_sim")

from benchmarks import rtc
from fluxvla_core.control.chunks import Chunk

DIM = 14


def command(t: float, value: float, held: bool = False) -> dict[str, Any]:
    row = {"event": "command", "phase": "run", "t": t, "wanted": [value] * DIM}
    return {**row, "command": [value] * DIM, **({"held": True} if held else {})}


def chunk(observed: float, arrived: float, first: float) -> dict[str, Any]:
    """Keyframes at 10 Hz that rise by 0.1 rad each."""
    keyframes = [[first + 0.1 * row] * DIM for row in range(10)]
    return {"event": "chunk", "t": arrived, "observed": observed, "rate_hz": 10.0} | {
        "keyframes": keyframes
    }


def at(first: float, observed: float) -> Chunk:
    rows = np.array(chunk(observed, observed, first)["keyframes"])
    return Chunk(rows, 10.0, observed, rows[0])


@pytest.mark.parametrize(("delay", "row"), [(0.0, 0), (0.05, 0), (0.1, 1), (0.2, 2), (0.3, 3)])
def test_a_gap_is_where_the_first_keyframe_to_come_lies(delay: float, row: int) -> None:
    """The old chunk goes through 0.1 j after j tenths; the new one, asked at 0.5 s, is off."""
    old, new = at(0.1, 0.0), at(0.6, 0.5)
    assert rtc.gap(old, new, 0.5 + delay) == pytest.approx(0.0, abs=1e-9)
    moved = new.actions.copy()
    moved[row, 2] += 0.25
    moved[row, 6] += 9.0  # a gripper's
    apart = Chunk(moved, 10.0, 0.5, new.anchor)
    # At 0.8 s and more the old one still lasts; it ends after its tenth keyframe.
    assert rtc.gap(old, apart, 0.5 + delay) == pytest.approx(0.25)
    assert rtc.gap(old, at(0.0, 1.0), 1.0 + delay) is None


def test_a_chunk_is_late_that_the_arm_waits_for() -> None:
    events = [
        chunk(0.0, 0.0, 0.1),
        command(0.0, 0.0),
        command(0.02, 0.1),
        chunk(0.02, 0.04, 0.1),
        command(0.04, 0.1),
        command(0.06, 0.1, held=True),
        chunk(0.04, 0.08, 0.1),
        command(0.08, 0.2),
    ]
    assert rtc.late(events) == [False, True]


def test_the_figures_of_an_episode() -> None:
    heights = [0.0, 0.1, 0.2, 0.5, 0.6, 0.7]
    events = [
        chunk(0.0, 0.0, 0.1),
        *(command(0.02 * i, height) for i, height in enumerate(heights)),
        chunk(0.1, 0.1, 0.4),
    ]
    found = rtc.figures(events)
    # After two tenths the old one is at 0.2, and there the new one begins with 0.4.
    assert found["gaps"] == pytest.approx([0.2])
    assert found["late"] == [False]
    assert found["largest_step_rad"] == pytest.approx(0.3)
    bends = np.diff(heights, 2) * rtc.HZ**2
    assert found["acceleration_rms"] == pytest.approx(np.sqrt(np.mean(bends**2)))
