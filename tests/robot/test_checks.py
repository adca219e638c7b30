"""Readings that a policy may act on, and those that it may not."""

from __future__ import annotations

import numpy as np
import pytest

from fluxvla_core.contracts.frame import Frame
from fluxvla_core.errors import SafetyStop
from fluxvla_core.robot.observations import FreshnessGate
from fluxvla_core.robot.robot import check_frame
from fluxvla_core.spec import Camera, EmbodimentSpec, Joint

ARM = EmbodimentSpec(
    "arm",
    (Joint("a", "rad", -1, 1, 1, 1), Joint("b", "rad", -1, 1, 1, 1)),
    (Camera("front", 4, 6), Camera("wrist", 4, 6)),
    50,
)


def frame(state=(0.0, 0.0), front=None, **images):
    front = np.zeros((4, 6, 3), np.uint8) if front is None else front
    return Frame(np.array(state), {"front": front, **images}, {})


def test_a_frame_as_described_passes():
    check_frame(frame(), ARM, ["front"])


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (frame(state=(0.0,)), r"state has shape \(1,\); arm has \(2,\)"),
        (frame(state=(0.0, np.nan)), "state is not finite for b"),
        (frame(front=np.zeros((4, 6), np.uint8)), r"camera front gives \(4, 6\) uint8"),
        (frame(front=np.zeros((4, 6, 3))), r"camera front gives \(4, 6, 3\) float64"),
        (frame(front=np.zeros((8, 6, 3), np.uint8)), r"the embodiment says \(4, 6, 3\) uint8"),
    ],
)
def test_a_frame_that_is_not_as_described_is_refused(bad, message):
    with pytest.raises(SafetyStop, match=message) as caught:
        check_frame(bad, ARM, ["front"])
    assert caught.value.rule == "frame"


def test_only_the_cameras_that_are_needed_must_be_there():
    with pytest.raises(SafetyStop, match="camera wrist gave no image"):
        check_frame(frame(), ARM, ["front", "wrist"])


@pytest.fixture
def gate():
    return FreshnessGate(max_age_s=0.5, max_skew_s=0.2)


def stamps(state, front):
    return {"state": state, "front": front}


def test_fresh_streams_pass_and_the_oldest_ones_age_is_told(gate):
    assert gate.check(stamps(9.9, 9.8), ["front"], now=10.0) == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("state", "front", "message"),
    [
        (9.4, 9.4, "stream state is stale: its newest data is 0.60 s old, safety.max_age_s is"),
        (10.0, 9.45, "stream front is stale"),
        (10.0, 9.7, "streams front and state are 0.30 s apart, safety.max_skew_s is 0.2"),
        (10.2, 10.0, "stream state is stamped 0.200 s in the future"),
        (10.0, None, "stream front has no receipt stamp"),
        (float("nan"), 10.0, "stream state has no receipt stamp"),
    ],
)
def test_streams_that_may_not_be_acted_on(gate, state, front, message):
    with pytest.raises(SafetyStop, match=message) as caught:
        gate.check(stamps(state, front), ["front"], now=10.0)
    assert caught.value.rule == "freshness"


def test_a_stream_that_runs_backwards_is_noticed(gate):
    gate.check(stamps(9.9, 9.95), ["front"], now=10.0)

    with pytest.raises(SafetyStop, match=r"stream front went back in time by 0.050 s"):
        gate.check(stamps(10.0, 9.9), ["front"], now=10.0)


def test_a_repeated_reading_passes_until_it_is_too_old(gate):
    for now in (10.0, 10.2, 10.4):
        gate.check(stamps(10.0, 10.0), ["front"], now=now)
    with pytest.raises(SafetyStop, match="stale"):
        gate.check(stamps(10.0, 10.0), ["front"], now=10.6)


def test_cameras_that_are_not_needed_are_not_looked_at(gate):
    assert gate.check({"state": 10.0, "side": 1.0}, [], now=10.0) == 0.0
