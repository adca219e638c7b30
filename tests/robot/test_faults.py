"""Whatever goes wrong, the robot is stopped, the cause is named, and nothing unsafe was sent."""

from __future__ import annotations

import re
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from fluxvla_core.errors import Faulted, FluxError, NotReady, RunFailed, SafetyStop
from fluxvla_core.ros2 import Stale
from tests.robot.faults import assert_braked, assert_stopped, fails, spoil


def test_a_part_of_an_episode_that_ends_the_program(bench):
    def leave(action):
        if len(bench.arm.sent) >= 20:
            sys.exit(0)
        return action

    error = fails(
        bench,
        RunFailed,
        r"something in the episode ended the program \(SystemExit: 0\); the robot was stopped",
        action_filters=[leave],
    )
    assert error.exit_code == 1
    assert_stopped(bench, "run", "SystemExit: 0")
    assert_braked(bench)


@pytest.mark.parametrize("name", ["get_frame", "stop"])
def test_an_operator_that_ends_the_program(bench, name):
    bench.arm.faults = {name: SystemExit(0), "after": 20}
    if name == "stop":
        bench.run(max_publish_step=30)
        assert "warning: Arm.stop raised SystemExit: 0" in bench.notes.lines
        assert bench.arm.calls[-1] == "close"
        return
    fails(bench, SafetyStop, r"Arm\.get_frame\(\) raised SystemExit: 0")
    assert_stopped(bench, "frame", "SystemExit")


@pytest.mark.parametrize("after", [0, 7])
def test_an_operator_that_raises_in_send_action(bench, after):
    bench.arm.faults = {"send_action": OSError("cable pulled"), "after": after}

    fails(bench, Faulted, "Arm.send_action raised OSError: cable pulled")
    assert_stopped(bench, "operator", "cable pulled")
    assert len(bench.arm.sent) == after


def test_an_operator_that_raises_in_get_frame(bench):
    bench.arm.faults = {"get_frame": Faulted("the camera is gone"), "after": 20}

    fails(bench, Faulted, "the camera is gone")
    assert_stopped(bench, "operator", "camera is gone")


def test_an_operator_whose_stop_raises_is_reported_and_closed(bench):
    bench.policy.faults[2] = ValueError("x")
    bench.arm.faults = {"stop": OSError("no answer")}

    fails(bench, RunFailed, "the policy raised")

    assert bench.arm.calls[-1] == "close"
    # Tried again at the run's end, and not said again.
    assert bench.notes.lines.count("warning: Arm.stop raised OSError: no answer") == 1


def test_a_robot_that_does_not_follow(bench):
    bench.arm.faults = {"stuck": True}
    bench.policy.stride = 0.3
    bench.arm.get_state = lambda: bench.arm.state

    fails(bench, SafetyStop, r"shoulder is 0\.\d+ away from its command for 0.2\d s")
    assert_stopped(bench, "tracking", "away from its command")


@pytest.mark.parametrize("lag", [0.92, 1.0])
@pytest.mark.parametrize("told", [True, False])
def test_an_arm_that_is_off_its_command_is_stopped_within_its_limits(bench, lag, told):
    """It lags, or it is blocked but not yet so far off that it would be noticed."""
    arm, pose = bench.arm, bench.arm.state

    def follow(action):
        arm.sent.append(np.array(action))
        arm.state = arm.state + (1 - lag) * (action - arm.state)
        arm.clock.advance(0.02)

    arm.send_action = follow
    if told:
        arm.get_state = lambda: arm.state
    bench.policy = Sweep(arm, fails_at=0.25)

    fails(bench, FluxError, "the sweep is over", max_publish_step=500)

    bench.assert_within_limits()
    np.testing.assert_array_equal(arm.sent[-1], arm.sent[-2])
    if told and lag == 1.0:
        np.testing.assert_array_equal(arm.sent[-1], pose)
    if lag < 1.0:
        assert arm.sent[-1][0] > 0.25, "it gets there by itself"


class Sweep:
    """Moves the shoulder on and on, and fails once its command is so far off the arm."""

    action_rate_hz, horizon = 10.0, 2

    def __init__(self, arm, fails_at):
        self.arm, self.embodiment, self.fails_at = arm, arm.embodiment, fails_at
        self.goal = 0.0

    def reset(self, seed):
        return

    def predict_action(self, observation):
        if self.arm.sent and abs(self.arm.sent[-1][0] - self.arm.state[0]) > self.fails_at - 0.05:
            raise ValueError("the sweep is over")
        self.goal += 0.2
        return np.array([[self.goal - 0.1, 0.0, 0.5], [self.goal, 0.0, 0.5]])


def test_a_blocked_robot_is_noticed_from_observations_alone(bench):
    bench.arm.faults = {"stuck": True}
    bench.policy.stride = 0.2

    fails(bench, SafetyStop, "shoulder is .* away from its command", max_publish_step=500)
    assert_stopped(bench, "tracking", "shoulder")


@pytest.mark.parametrize("after", [0, 20])
@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda frame: None, r"Arm\.get_frame\(\) gave a NoneType, not a Frame"),
        (lambda frame: (frame.state, frame.images), r"Arm\.get_frame\(\) gave a tuple, not a Fr"),
        (lambda frame: replace(frame, images=None), "images of what Arm.get_frame.. gave is a No"),
        (lambda frame: replace(frame, stamps=3.0), "stamps of what Arm.get_frame.. gave is a fl"),
        (lambda frame: replace(frame, state=["up"] * 3), "Arm.get_frame.., or what the runner"),
        (lambda frame: 1 / 0, r"Arm\.get_frame\(\) raised ZeroDivisionError"),
    ],
)
def test_a_frame_that_is_none(bench, after, change, said):
    good = bench.arm.get_frame
    bench.arm.get_frame = lambda: (change if len(bench.arm.sent) >= after else lambda f: f)(good())

    error = fails(bench, SafetyStop, said)
    assert_stopped(bench, "frame", error.what)
    if after:
        assert_braked(bench)


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("get_state", lambda: None, "Arm.get_state() is no array of numbers, but a NoneType"),
        ("get_state", lambda: np.zeros(2), "Arm.get_state() has shape (2,); testarm has (3,)"),
        ("get_state", lambda: 1 / 0, "Arm.get_state() raised ZeroDivisionError"),
        ("last_action", np.zeros(2), "Arm.last_action has shape (2,); testarm has (3,)"),
        ("speed_scaling", "fast", "Arm.speed_scaling is 'fast', not a finite number"),
        ("task_done", lambda: "no", "Arm.task_done() gave 'no', neither True nor False"),
    ],
)
def test_an_operator_that_says_nonsense_of_itself(bench, name, value, said):
    setattr(bench.arm, name, value)

    fails(bench, SafetyStop, re.escape(said))
    assert_stopped(bench, "frame", said)


def test_a_state_that_is_not_finite_after_a_command(bench):
    """The tracking watch compares with it: nothing is greater than NaN."""
    bench.arm.get_state = lambda: bench.arm.state * (np.nan if len(bench.arm.sent) > 20 else 1.0)

    fails(bench, SafetyStop, r"Arm\.get_state\(\) is not finite for shoulder, elbow, jaw")
    assert_stopped(bench, "frame", "not finite")
    assert_braked(bench)


def test_a_stream_that_froze(bench):
    bench.arm.faults["frozen_after"] = 20

    fails(bench, SafetyStop, r"stream state is stale: its newest data is \d\.\d\d s old")
    assert_stopped(bench, "freshness", "stale")


def test_a_stream_that_falls_silent_does_not_keep_the_arm_from_braking(bench):
    """It is silent still when the arm brakes; what is sent then is recorded like the rest."""

    def state():
        if len(bench.arm.sent) >= 20:
            raise Stale("cam is silent")
        return bench.arm.state

    bench.arm.get_state = state
    bench.policy.stride = 0.2

    fails(bench, Stale, "cam is silent")
    assert_stopped(bench, "freshness", "cam is silent")
    commands = [row for row in bench.trace() if row["event"] == "command"]
    assert len(commands) == len(bench.arm.sent)
    assert [row["phase"] for row in commands[20:]] == ["stop"] * (len(commands) - 20)
    assert len(commands) > 25
    np.testing.assert_allclose(bench.arm.sent[-1], bench.arm.sent[-2], atol=1e-2)


def test_a_robot_that_never_gives_a_reading(bench):
    bench.arm.faults["get_frame"] = NotReady("no joint states on /joint_states")

    fails(
        bench,
        NotReady,
        "no complete frame within 0.1 s: no joint states on /joint_states",
        ready_timeout=0.1,
    )
    assert bench.arm.sent == []
    assert_stopped(bench, "operator", "no complete frame")


@pytest.mark.realtime
def test_a_reading_that_is_old_moves_nothing(bench, make_arm):
    """A driver that froze long ago, behind an operator that gives its last reading again."""
    bench.arm = make_arm(realtime=True)
    bench.arm.faults["frozen_after"] = -1
    bench.arm.stamped = bench.arm.now() - 100

    error = fails(
        bench, NotReady, "no complete frame within 1 s: stream state is stale", ready_timeout=1.0
    )
    assert "froze" in error.cause
    assert bench.arm.sent == []


def test_a_robot_that_is_ready_after_a_while(bench):
    begin = time.monotonic()

    def warm_up():
        if time.monotonic() - begin < 0.1:
            raise NotReady("warming up")

    bench.arm.faults["get_frame"] = warm_up

    assert bench.run(max_publish_step=5)["outcome"] == "max_steps"


def test_a_joint_outside_its_limits_at_the_start(bench):
    bench.arm.state[1] = 2.5

    fails(bench, SafetyStop, r"elbow is at 2.5, outside its limits \[-2, 2\] rad")
    assert bench.arm.sent == []


def test_an_image_of_another_size(bench):
    from fluxvla_core.contracts.frame import Frame

    good = bench.arm.get_frame

    def smaller():
        frame = good()
        if len(bench.arm.sent) < 20:
            return frame
        return Frame(frame.state, {"front": np.zeros((12, 16, 3), np.uint8)}, frame.stamps)

    bench.arm.get_frame = smaller

    fails(bench, SafetyStop, r"camera front gives \(12, 16, 3\) uint8, the embodiment says \(24")
    assert_stopped(bench, "frame", "camera front")


def test_nothing_runs_after_a_trip_until_somebody_re_arms(bench):
    bench.policy.faults[1] = spoil(0, 0, np.nan)
    runner = bench.runner()
    runner.run_setup()
    with pytest.raises(SafetyStop):
        runner.run()

    with pytest.raises(SafetyStop, match="stopped by rule chunk: the policy's chunk is not") as hit:
        runner.run()
    assert "re-arm" in str(hit.value)
    assert bench.arm.sent == []

    runner.latch.rearm()
    assert runner.run()["outcome"] == "max_steps"


def test_a_filter_that_makes_nonsense(bench):
    fails(
        bench,
        SafetyStop,
        r"action filter \w+ made an action of shape \(2,\)",
        action_filters=[lambda action: action[:2]],
    )
    assert_stopped(bench, "limits", "action filter")


def test_a_record_that_cannot_be_written_is_an_error_after_the_robot_was_stopped(bench):
    (bench.work_dir / "inference").write_text("not a folder")

    fails(bench, RunFailed, "cannot record the episode")
    assert bench.arm.calls == ["connect", "stop", "close"]
    assert bench.arm.sent == []
