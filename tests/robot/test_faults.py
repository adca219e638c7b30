"""Whatever goes wrong, the robot is stopped, the cause is named, and nothing unsafe was sent."""

from __future__ import annotations

import ctypes
import re
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from fluxvla_core.errors import Faulted, FluxError, NotReady, RunFailed, SafetyStop
from fluxvla_core.ros2 import Stale


def spoil(row: int, column: int, value: float):
    def change(chunk):
        chunk[row, column] = value
        return chunk

    return change


def stand_still(seconds):
    ctypes.PyDLL(None).usleep(int(seconds * 1e6))


def fails(bench, kind, match, **arguments):
    with pytest.raises(kind, match=match) as caught:
        bench.run(**arguments)
    return caught.value


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
    """The last commands slow down to a hold within the acceleration limit."""
    np.testing.assert_allclose(bench.arm.sent[-1], bench.arm.sent[-2], atol=1e-2)
    assert bench.trace()[-2]["phase"] == "stop" or len(bench.arm.sent) == 25


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


@pytest.mark.parametrize("asynchronous", [False, True])
@pytest.mark.realtime
def test_a_policy_that_hangs_on_a_robot(bench, make_arm, asynchronous):
    """The sender goes on sending holds in the meantime; then the motion is stopped."""
    bench.arm = make_arm(realtime=True)
    bench.policy.faults[4] = lambda chunk: time.sleep(3)

    fails(
        bench,
        SafetyStop,
        r"waits for a chunk for \d\.\d+ s, safety.starvation_s is 0.3: the policy took 0\.3",
        async_execution=asynchronous,
        max_publish_step=500,
        safety={"starvation_s": 0.3},
    )
    assert_stopped(bench, "starvation", "waits for a chunk")
    assert any("the policy still hangs" in line for line in bench.notes.lines)
    holds = bench.arm.sent[-3:]
    np.testing.assert_array_equal(holds[0], holds[-1])


def test_a_policy_that_hangs_in_a_simulation(bench):
    bench.policy.faults[2] = lambda chunk: time.sleep(3)

    fails(
        bench,
        SafetyStop,
        r"there was no chunk within 0.2 s: the policy took 0\.\d+ s of that",
        safety={"first_chunk_s": 0.2},
    )
    assert_stopped(bench, "starvation", "no chunk")


@pytest.mark.parametrize("asynchronous", [False, True])
@pytest.mark.realtime
def test_a_get_frame_that_blocks_in_motion_is_not_the_policys_doing(bench, make_arm, asynchronous):
    bench.arm = make_arm(realtime=True)
    bench.arm.faults = {"get_frame": lambda: time.sleep(3), "after": 20}

    error = fails(
        bench,
        SafetyStop,
        r"safety.starvation_s is 0.3: Arm\.get_frame\(\) took 0\.[23]\d s of that",
        async_execution=asynchronous,
        max_publish_step=500,
        safety={"starvation_s": 0.3},
    )
    assert "camera that is read in this call" in error.cause
    assert_stopped(bench, "starvation", "Arm.get_frame()")
    assert any("Arm.get_frame() still hangs" in line for line in bench.notes.lines)


def test_a_get_frame_that_blocks_in_a_simulation_is_told(bench):
    """While it does: nobody knows whether it will return."""

    def once():
        if len(bench.arm.sent) >= 20:
            bench.arm.faults.clear()
            time.sleep(0.6)

    bench.arm.faults = {"get_frame": once}
    assert bench.run(safety={"starvation_s": 0.2})["outcome"] == "max_steps"

    (line,) = [line for line in bench.notes.lines if line.startswith("warning")]
    assert "Arm.get_frame() has not returned for 0." in line


def test_a_get_frame_that_takes_too_long_in_a_simulation(bench):
    bench.arm.faults = {"get_frame": lambda: time.sleep(0.3), "after": 20}

    fails(
        bench,
        SafetyStop,
        r"no chunk within 0.2 s: Arm\.get_frame\(\) took 0\.3\d s of that",
        safety={"first_chunk_s": 0.2},
    )
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

    error = fails(bench, SafetyStop, r"streams state and front are 0\.4\d s apart")
    assert re.match(r"Arm\.get_frame\(\) took 0\.4\d s; front came last in it", error.cause)


@pytest.mark.realtime
def test_a_process_that_stood_still_blames_neither_the_policy_nor_a_stream(bench, make_arm):
    """Native code that sleeps without giving up the interpreter: nothing else runs meanwhile."""
    bench.arm = make_arm(realtime=True)
    bench.policy.faults[4] = lambda chunk: stand_still(0.8)

    fails(
        bench,
        SafetyStop,
        r"safety.starvation_s is 0.3: this machine took 0\.\d+ s of that",
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
    error = fails(bench, SafetyStop, "is stale: .*; this machine let the program stand still for")
    assert "the process was paused" in error.cause


@pytest.mark.realtime
def test_a_send_action_that_blocks_is_told(bench, make_arm):
    bench.arm = make_arm(realtime=True)

    def once():
        if len(bench.arm.sent) == 20:
            time.sleep(0.6)

    bench.arm.faults = {"send_action": once}
    bench.run(safety={"starvation_s": 0.2})

    (line,) = [line for line in bench.notes.lines if line.startswith("warning")]
    assert "Arm.send_action() has not returned for 0." in line


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


@pytest.mark.realtime
def test_an_operator_whose_stop_hangs_does_not_hang_the_run(bench, make_arm, monkeypatch):
    monkeypatch.setattr("fluxvla_core.robot.robot.STOP_S", 0.1)
    bench.arm = make_arm(realtime=True)
    bench.arm.faults = {"stop": lambda: time.sleep(1)}

    bench.run(max_publish_step=5)

    (line,) = [line for line in bench.notes.lines if "emergency" in line]
    assert "Arm.stop did not return within 0.1 s: use the robot's emergency stop" in line


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


def test_a_policy_that_raises_in_reset(bench):
    def reset(seed):
        raise ValueError("no such seed")

    bench.policy.reset = reset

    fails(bench, RunFailed, r"the policy raised ValueError in reset\(\): no such seed")
    assert_stopped(bench, "policy", "no such seed")
    assert bench.arm.sent == []


def test_a_stream_that_froze(bench):
    bench.arm.faults["frozen_after"] = 20

    fails(bench, SafetyStop, r"stream state is stale: its newest reading is \d\.\d\d s old")
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
        "no complete reading within 0.1 s: no joint states on /joint_states",
        ready_timeout=0.1,
    )
    assert bench.arm.sent == []
    assert_stopped(bench, "operator", "no complete reading")


@pytest.mark.realtime
def test_a_reading_that_is_old_moves_nothing(bench, make_arm):
    """A driver that froze long ago, behind an operator that gives its last reading again."""
    bench.arm = make_arm(realtime=True)
    bench.arm.faults["frozen_after"] = -1
    bench.arm.stamped = bench.arm.now() - 100

    error = fails(
        bench, NotReady, "no complete reading within 1 s: stream state is stale", ready_timeout=1.0
    )
    assert "froze" in error.cause
    assert bench.arm.sent == []


def test_motion_does_not_begin_with_an_answer_that_took_long(bench, make_arm):
    """The second may, too: libraries compile more than once, and servers pause."""
    bench.arm = make_arm(realtime=True)

    def slow(chunk):
        time.sleep(0.5)
        return chunk

    bench.policy.faults = {1: slow, 2: slow}
    bench.run(max_publish_step=20, safety={"starvation_s": 0.3})

    assert len(bench.policy.asked) >= 3
    first = next(row for row in bench.trace() if row["event"] == "chunk")
    assert first["ms"]["policy"] < 300


def test_a_policy_that_is_slow_for_good_is_not_asked_for_ever(bench, make_arm):
    """Long chunks may make up for it; where they do not, starvation says so."""
    bench.arm = make_arm(realtime=True)
    think = bench.policy.predict_action

    def slow(observation):
        time.sleep(0.3)
        return think(observation)

    bench.policy.predict_action = slow
    bench.run(max_publish_step=20, safety={"starvation_s": 0.2})

    first = next(row for row in bench.trace() if row["event"] == "chunk")
    assert first["ms"]["policy"] >= 300
    assert len(bench.policy.asked) >= 3


def test_a_robot_whose_get_frame_hangs(bench, make_arm):
    bench.arm = make_arm(realtime=True)
    bench.arm.faults["get_frame"] = lambda: time.sleep(2)

    fails(bench, NotReady, r"Arm\.get_frame does not return", ready_timeout=0.2)
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
