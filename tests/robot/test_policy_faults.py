"""A policy that fails: the robot is stopped, the cause is named, and nothing unsafe was sent."""

from __future__ import annotations

import time

import numpy as np
import pytest

from fluxvla_core.errors import RunFailed, SafetyStop
from tests.robot.faults import assert_braked, assert_stopped, fails, seconds, spoil


@pytest.mark.parametrize("call", [1, 2])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_chunk_that_is_not_finite(bench, call, bad):
    bench.policy.faults[call] = spoil(3, 1, bad)

    fails(bench, SafetyStop, "chunk is not finite: action 3, elbow is")
    assert_stopped(bench, "chunk", "not finite")
    assert len(bench.arm.sent) <= 35 * (call - 1)


@pytest.mark.parametrize("shape", [(5, 2), (5, 4), (15,), (0, 3), (1, 5, 3)])
def test_a_chunk_of_a_wrong_shape(bench, shape):
    bench.policy.faults[2] = lambda chunk: np.zeros(shape)

    fails(bench, SafetyStop, r"chunk has shape \(.*\); testarm takes \(T, 3\)")
    assert_stopped(bench, "chunk", "has shape")


def test_a_chunk_of_another_length_than_the_policy_said(bench):
    bench.policy.faults[2] = lambda chunk: chunk[:3]

    fails(bench, SafetyStop, "chunk has 3 actions; it said 5")
    assert_stopped(bench, "chunk", "3 actions")


@pytest.mark.parametrize("answer", ["left a bit", None, np.zeros((5, 3), complex)])
def test_a_chunk_that_is_no_array(bench, answer):
    bench.policy.faults[1] = lambda chunk: answer

    fails(bench, SafetyStop, "the policy's chunk is no array of numbers")
    assert_stopped(bench, "chunk", "no array")
    assert bench.arm.sent == []


def test_a_chunk_that_jumps(bench):
    def jump(chunk):
        chunk[2:, 0] = -1.0
        chunk[:2, 0] = 1.5
        return chunk

    bench.policy.faults[2] = jump

    fails(bench, SafetyStop, "action 2 wants shoulder to jump by -2.5; at full speed")
    assert_stopped(bench, "chunk", "jump")
    assert_braked(bench)


def test_a_chunk_far_beyond_a_limit(bench):
    bench.policy.faults[2] = spoil(4, 0, 9.0)

    fails(bench, SafetyStop, r"action 4 wants shoulder at 9, far beyond its limits \[-1, 1.5\]")
    assert_stopped(bench, "chunk", "far beyond")


def test_a_chunk_a_little_beyond_a_limit_is_clamped(bench):
    bench.policy.goal = 1.6

    result = bench.run(max_publish_step=150)

    assert result["outcome"] == "max_steps"
    assert bench.arm.state[0] == 1.5
    assert bench.episode()["clamps"]["shoulder"].keys() >= {"position"}
    bench.assert_within_limits()


@pytest.mark.parametrize("realtime", [False, pytest.param(True, marks=pytest.mark.realtime)])
def test_a_policy_that_raises(bench, make_arm, realtime):
    bench.arm = make_arm(realtime=realtime)
    bench.policy.faults[3] = ValueError("out of memory")

    error = fails(bench, RunFailed, "the policy raised ValueError: out of memory")
    assert error.exit_code == 1
    assert_stopped(bench, "policy", "out of memory")
    assert_braked(bench)


@pytest.mark.parametrize("asynchronous", [False, True])
@pytest.mark.realtime
def test_a_policy_that_hangs_on_a_robot(bench, make_arm, hang, asynchronous):
    """The sender goes on sending holds in the meantime; then the motion is stopped."""
    bench.arm = make_arm(realtime=True)
    bench.policy.faults[4] = hang

    # Longer than a machine stands still, which would be to blame then.
    error = fails(
        bench,
        SafetyStop,
        r"waits for a chunk for \d+\.\d+ s, safety.starvation_s is 1: the policy took",
        async_execution=asynchronous,
        max_publish_step=500,
        safety={"starvation_s": 1.0, "max_age_s": 5.0},
    )
    assert seconds(error, "the policy took") > 0.5
    assert_stopped(bench, "starvation", "waits for a chunk")
    assert any("the policy still hangs" in line for line in bench.notes.lines)
    holds = bench.arm.sent[-3:]
    np.testing.assert_array_equal(holds[0], holds[-1])


def test_a_policy_that_hangs_in_a_simulation(bench, hang):
    bench.policy.faults[2] = hang

    fails(
        bench,
        SafetyStop,
        r"there was no chunk within 1 s: the policy took \d+\.\d+ s of that",
        safety={"first_chunk_s": 1.0},
    )
    assert_stopped(bench, "starvation", "no chunk")


def test_a_policy_that_raises_in_reset(bench):
    def reset(seed):
        raise ValueError("no such seed")

    bench.policy.reset = reset

    fails(bench, RunFailed, r"the policy raised ValueError in reset\(\): no such seed")
    assert_stopped(bench, "policy", "no such seed")
    assert bench.arm.sent == []


@pytest.mark.realtime
def test_motion_does_not_begin_with_an_answer_that_took_long(bench, make_arm):
    """The second may, too: libraries compile more than once, and servers pause."""
    bench.arm = make_arm(realtime=True)

    def slow(chunk):
        time.sleep(1.5)
        return chunk

    bench.policy.faults = {1: slow, 2: slow}
    bench.run(max_publish_step=20, safety={"starvation_s": 1.2, "max_age_s": 5.0})

    assert len(bench.policy.asked) >= 3
    first = next(row for row in bench.trace() if row["event"] == "chunk")
    assert first["ms"]["policy"] < 1200


@pytest.mark.realtime
def test_a_policy_that_is_slow_for_good_is_not_asked_for_ever(bench, make_arm, make_waver):
    """Long chunks may make up for it; where they do not, starvation says so."""
    bench.arm = make_arm(realtime=True)
    # One chunk is enough for this run, also where the machine stands still.
    bench.policy = make_waver(horizon=50)
    think = bench.policy.predict_action

    def slow(observation):
        time.sleep(0.3)
        return think(observation)

    bench.policy.predict_action = slow
    bench.run(max_publish_step=20, safety={"starvation_s": 0.2})

    first = next(row for row in bench.trace() if row["event"] == "chunk")
    assert first["ms"]["policy"] >= 300
    assert len(bench.policy.asked) >= 3
