"""Operators whose calls block or return late: the call is named, and the policy is not blamed."""

from __future__ import annotations

import ctypes
import time

import pytest

from fluxvla_core.errors import NotReady, SafetyStop
from tests.robot.faults import assert_stopped, fails, seconds


def stand_still(seconds):
    ctypes.PyDLL(None).usleep(int(seconds * 1e6))


@pytest.mark.parametrize("asynchronous", [False, True])
@pytest.mark.realtime
def test_a_get_frame_that_blocks_in_motion_is_not_the_policys_doing(
    bench, make_arm, hang, asynchronous
):
    bench.arm = make_arm(realtime=True)
    bench.arm.faults = {"get_frame": hang, "after": 20}

    # Longer than a machine stands still, which would be to blame then.
    error = fails(
        bench,
        SafetyStop,
        r"safety.starvation_s is 1: Arm\.get_frame\(\) took \d+\.\d+ s of that",
        async_execution=asynchronous,
        max_publish_step=500,
        safety={"starvation_s": 1.0, "max_age_s": 5.0},
    )
    assert seconds(error, r"get_frame\(\) took") > 0.5
    assert "camera that is read in this call" in error.cause
    assert_stopped(bench, "starvation", "Arm.get_frame()")
    assert any("Arm.get_frame() still hangs" in line for line in bench.notes.lines)


def test_a_get_frame_that_blocks_in_a_simulation_is_told(bench):
    """While it does: nobody knows whether it will return."""

    def once():
        if len(bench.arm.sent) >= 20:
            bench.arm.faults.clear()
            time.sleep(1.5)  # longer than whoever tells it may be kept waiting

    bench.arm.faults = {"get_frame": once}
    assert bench.run(safety={"starvation_s": 0.2})["outcome"] == "max_steps"

    (line,) = [line for line in bench.notes.lines if line.startswith("warning")]
    assert "Arm.get_frame() has not returned for " in line


def test_a_get_frame_that_takes_too_long_in_a_simulation(bench):
    bench.arm.faults = {"get_frame": lambda: time.sleep(1.2), "after": 20}

    error = fails(
        bench,
        SafetyStop,
        r"no chunk within 1 s: Arm\.get_frame\(\) took \d+\.\d+ s of that",
        safety={"first_chunk_s": 1.0},
    )
    assert seconds(error, r"get_frame\(\) took") >= 1.0
    assert_stopped(bench, "starvation", "Arm.get_frame()")


@pytest.mark.realtime
def test_a_get_frame_that_returns_late_says_which_stream_came_last(bench, make_arm):
    bench.arm = make_arm(realtime=True)
    good = bench.arm.get_frame

    def late():
        frame = good()
        if len(bench.arm.sent) >= 20:
            time.sleep(0.4)
            frame.stamps["front"] = bench.arm.now()
        return frame

    bench.arm.get_frame = late

    error = fails(bench, SafetyStop, r"streams state and front are \d+\.\d+ s apart")
    assert seconds(error, "streams state and front are") >= 0.4
    assert "; front came last in it" in error.cause
    assert seconds(error.cause, r"^Arm\.get_frame\(\) took") >= 0.4


@pytest.mark.realtime
def test_a_process_that_stood_still_blames_neither_the_policy_nor_a_stream(bench, make_arm):
    """Native code that sleeps without giving up the interpreter: nothing else runs meanwhile."""
    bench.arm = make_arm(realtime=True)

    def still(chunk):
        stand_still(0.8)
        time.sleep(0.5)  # the loop sees it before the chunk arrives, whichever thread runs first
        return chunk

    bench.policy.faults[4] = still

    fails(
        bench,
        SafetyStop,
        r"safety.starvation_s is 0.3: this machine took \d+\.\d+ s of that",
        max_publish_step=500,
        safety={"starvation_s": 0.3},
    )
    assert_stopped(bench, "starvation", "this machine")

    bench.arm, bench.policy.faults = make_arm(realtime=True), {}
    good = bench.arm.get_frame

    def paused():
        frame = good()
        if len(bench.arm.sent) >= 20:
            stand_still(0.8)
        return frame

    bench.arm.get_frame = paused
    error = fails(bench, SafetyStop, "is stale: .*; this machine did not run this process for")
    assert "the process was paused" in error.cause


@pytest.mark.realtime
def test_a_send_action_that_blocks_is_told(bench, make_arm):
    bench.arm = make_arm(realtime=True)

    def once():
        if len(bench.arm.sent) == 20:
            time.sleep(1.5)  # longer than whoever tells it may be kept waiting

    bench.arm.faults = {"send_action": once}
    bench.run(safety={"starvation_s": 0.2})

    (line,) = [line for line in bench.notes.lines if line.startswith("warning")]
    assert "Arm.send_action() has not returned for " in line


@pytest.mark.realtime
def test_an_operator_whose_stop_hangs_does_not_hang_the_run(bench, make_arm, monkeypatch):
    monkeypatch.setattr("fluxvla_core.robot.robot.STOP_S", 0.1)
    bench.arm = make_arm(realtime=True)
    bench.arm.faults = {"stop": lambda: time.sleep(3)}

    bench.run(max_publish_step=5)

    (line,) = [line for line in bench.notes.lines if "emergency" in line]
    assert "Arm.stop did not return within 0.1 s: use the robot's emergency stop" in line


@pytest.mark.realtime
def test_a_robot_whose_get_frame_hangs(bench, make_arm, hang):
    bench.arm = make_arm(realtime=True)
    bench.arm.faults["get_frame"] = hang

    fails(bench, NotReady, r"Arm\.get_frame does not return", ready_timeout=0.2)
    assert bench.arm.sent == []
