"""Joints that are commanded by their speed: limited as speeds, and held by being brought to 0."""

from __future__ import annotations

import json
import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fluxvla_core.control.limits import Clamp, CommandLimiter
from fluxvla_core.control.sender import check_pose, ramp
from fluxvla_core.errors import ConfigError, SafetyStop
from fluxvla_core.ros2.stop_motion import braking_commands, hold_target
from fluxvla_core.spec import EmbodimentSpec, Joint
from tests.robot.conftest import ARM, HOME, Arm

FORWARD = Joint.base("base_forward", "m/s", 0.5, 1.0, backward=0.2)
TURN = Joint.base("base_turn", "rad/s", 1.0, 4.0, jerk=40.0)
MOBILE = replace(ARM, name="mobile", joints=(*ARM.joints, FORWARD, TURN))
START = (*HOME, 0.0, 0.0)
DT = 0.02


def one(**changes) -> EmbodimentSpec:
    return EmbodimentSpec("one", (replace(FORWARD, **changes),), (), 50.0)


def assert_within(spec: EmbodimentSpec, start, commands, dt: float = DT) -> None:
    """Every limit of every joint, from the commands alone; a speed's are one derivative lower."""
    path = np.vstack([start, start, start, *np.asarray(commands)])
    first = np.diff(path, axis=0) / dt
    second = np.diff(first, axis=0) / dt
    third = np.diff(second, axis=0) / dt
    for index, joint in enumerate(spec.joints):
        assert path[:, index].min() >= joint.lower
        assert path[:, index].max() <= joint.upper
        changes = (first, second, third) if joint.by_speed else (second, third)
        if not joint.by_speed:
            assert np.abs(first[:, index]).max() <= joint.velocity
        assert np.abs(changes[0][:, index]).max() <= joint.acceleration
        if joint.jerk is not None:
            assert np.abs(changes[1][:, index]).max() <= joint.jerk * (1 + 1e-9)


wild = st.one_of(st.floats(-3, 3), st.sampled_from([-0.2, 0.0, 0.5, 1e300, -1e300, 1e-300]))


@settings(max_examples=300, deadline=None)
@given(
    chunk=st.lists(st.tuples(*[wild] * 5), min_size=1, max_size=60),
    share=st.floats(0.01, 1.0),
    scale=st.floats(0.05, 1.0),
)
def test_adversarial_speeds_keep_every_limit_and_come_to_rest(chunk, share, scale):
    limiter = CommandLimiter(MOBILE, DT, velocity_scale=scale, acceleration_scale=scale)
    limiter.start(START)

    commands, _ = limiter.run(np.array(chunk), share)
    stop = [limiter.brake() for _ in range(limiter.longest_stop)]

    assert_within(MOBILE, START, [*commands, *stop])
    for joint, column in ((FORWARD, 3), (TURN, 4)):
        assert np.abs(commands[:, column]).max() <= joint.velocity * scale
    assert limiter.at_rest
    assert (stop[-1][3:] == 0.0).all()


def test_a_speed_is_reached_and_left_at_full_acceleration():
    limiter = CommandLimiter(one(), DT)
    limiter.start([0.0])
    up, _ = limiter.run(np.full((30, 1), 0.5))
    steps = np.diff(up[:, 0], prepend=0.0)
    assert up[-1, 0] == 0.5
    np.testing.assert_allclose(steps[:24], FORWARD.acceleration * DT, rtol=1e-5)
    stop = [limiter.brake()[0] for _ in range(26)]
    np.testing.assert_allclose(-np.diff([0.5, *stop])[:24], FORWARD.acceleration * DT, rtol=1e-5)
    assert stop[-1] == 0.0


def test_a_steady_speed_is_no_rest():
    limiter = CommandLimiter(one(), DT)
    limiter.start([0.0])
    limiter.run(np.full((60, 1), 0.3))
    assert not limiter.at_rest
    assert limiter.rest() == 0.0
    assert limiter.last == 0.3  # only looked ahead


def test_a_wanted_speed_within_the_limits_passes_unchanged():
    limiter = CommandLimiter(one(), DT)
    limiter.start([0.0])
    wanted = 0.4 * np.sin(np.linspace(0.0, 1.5, 90))[:, None]
    commands, clamps = limiter.run(wanted)
    np.testing.assert_array_equal(commands, wanted)
    assert not any(clamps)


@pytest.mark.parametrize(
    ("wanted", "reason"), [(9.0, "velocity"), (-9.0, "velocity"), (0.4, "acceleration")]
)
def test_a_clamp_says_what_of_a_speed_was_limited(wanted, reason):
    limiter = CommandLimiter(one(), DT)
    limiter.start([0.0])
    given_, clamps = limiter.step([wanted])
    assert clamps == [Clamp("base_forward", wanted, given_[0], reason)]


def test_a_robot_that_a_person_slowed_down_drives_slower_too():
    limiter = CommandLimiter(one(), DT)
    limiter.start([0.0])
    limiter.run(np.full((60, 1), 0.5))
    commands, _ = limiter.run(np.full((60, 1), 0.5), 0.1)
    assert commands[-1, 0] == pytest.approx(0.05)
    assert np.abs(np.diff(commands[:, 0])).max() <= FORWARD.acceleration * DT


def test_an_episode_begins_at_rest():
    limiter = CommandLimiter(one(), DT)
    with pytest.raises(SafetyStop, match=r"base_forward moves at 0.1 m/s; an episode begins at"):
        limiter.start([0.1])
    limiter.start([0.01])  # an odometer is never quite still
    assert limiter.last == 0.0


def test_a_pose_has_no_speed():
    with pytest.raises(ConfigError, match=r"prepare_pose has base_turn move at 0.1 rad/s"):
        check_pose((*HOME, 0.0, 0.1), MOBILE)
    limiter = CommandLimiter(MOBILE, DT)
    limiter.start((0.3, 0.1, 0.5, 0.02, 0.0))
    way = ramp(limiter, START, 0.5)
    assert (way[:, 3:] == 0.0).all()


def test_a_stop_over_ros2_ends_at_0():
    last = np.array([0.1, 0.2, 0.5, 0.3, -0.6])
    state = np.array([0.1, 0.2, 0.5, 0.1, -0.2])
    target = hold_target(MOBILE, last, state, np.zeros(5))
    for before in (last, last - [0.01, 0.0, 0.0, 0.01, 0.0]):
        rows = braking_commands(MOBILE, last, before, DT, target)
        assert (rows[-1, 3:] == 0.0).all()
        assert np.abs(np.diff(np.vstack([last, rows])[:, 3])).max() <= FORWARD.acceleration * DT
    deltas = replace(MOBILE, action_mode="delta")
    assert (braking_commands(deltas, last, last, DT, target)[:, 3:] == 0.0).all()


@pytest.mark.parametrize(
    ("joint", "words"),
    [
        ({"unit": "m"}, "has unit m/s or rad/s, not 'm'"),
        ({"lower": 0.1}, "a speed of 0 is not in"),
        ({"velocity": 2.0}, "is not the larger of its limits"),
    ],
)
def test_a_speed_that_is_described_wrongly(joint, words):
    with pytest.raises(ValueError, match=words):
        replace(FORWARD, **joint)


def test_a_description_is_read_as_it_was_written():
    assert EmbodimentSpec.from_dict(json.loads(json.dumps(MOBILE.to_dict()))) == MOBILE
    assert Joint("base_forward", "m/s", -0.2, 0.5, 0.5, 1.0, kind="velocity") == FORWARD


class MobileArm(Arm):
    """The arm on a base; ``odometry`` False leaves the base out of what it reads."""

    def __init__(self, odometry: bool = True, stuck_base: bool = False) -> None:
        super().__init__(embodiment=MOBILE if odometry else replace(MOBILE, state_joints=JOINTS))
        self.stuck_base = stuck_base
        self.state = np.array(START if odometry else HOME)

    def send_action(self, action) -> None:
        super().send_action(action)
        if self.stuck_base:
            self.state[3:] = 0.0
        self.state = self.state[: self.embodiment.state_dim]


JOINTS = ARM.joints


class Driver:
    """Drives on and on, and moves the shoulder."""

    action_rate_hz, horizon = 10.0, 5

    def __init__(self, embodiment, fault=None, at=3):
        self.embodiment, self.fault, self.at = embodiment, fault, at
        self.asked = 0

    def reset(self, seed):
        return

    def predict_action(self, observation):
        self.asked += 1
        if self.fault is not None and self.asked >= self.at:
            return self.fault()
        pose = np.asarray(observation["qpos"], dtype=float)
        chunk = np.tile([pose[0], 0.0, 0.5, 0.4, -0.8], (5, 1))
        chunk[:, 0] += 0.01 * np.arange(1, 6)
        return chunk


def fails():
    raise RuntimeError("no idea")


@pytest.mark.parametrize("odometry", [True, False])
def test_an_episode_ends_with_the_base_at_rest(bench, odometry):
    bench.arm = MobileArm(odometry)
    bench.policy = Driver(bench.arm.embodiment)
    bench.run()
    sent = np.array(bench.arm.sent)
    assert sent[:, 3].max() == pytest.approx(0.4)
    assert sent[:, 4].min() == pytest.approx(-0.8)
    assert (sent[-1, 3:] == 0.0).all()
    assert_within(MOBILE, START, sent)


@pytest.mark.parametrize("fault", [fails, lambda: np.full((5, 5), np.nan)])
def test_every_stop_brings_the_base_to_rest(bench, fault):
    bench.arm = MobileArm()
    bench.policy = Driver(bench.arm.embodiment, fault)
    with pytest.raises(Exception, match=r"no idea|not finite"):
        bench.run()
    sent = np.array(bench.arm.sent)
    assert sent[:, 3].max() > 0.1
    assert (sent[-1, 3:] == 0.0).all()
    assert_within(MOBILE, START, sent)
    assert bench.arm.calls[-3:] == ["stop", "stop", "close"]


@pytest.mark.realtime
def test_while_the_policy_is_late_the_base_rests(bench):
    """It thinks for longer than the base takes to come to rest."""

    def late():
        time.sleep(1.0)
        return np.tile([0.0, 0.0, 0.5, 0.4, -0.8], (5, 1))

    bench.arm = MobileArm()
    bench.arm.clock = None
    bench.policy = Driver(bench.arm.embodiment, late)
    bench.run(max_publish_step=200, safety={"starvation_s": 5.0})
    sent = np.array(bench.arm.sent)
    driving = np.flatnonzero(sent[:, 3] > 0.1)
    rests = np.flatnonzero((sent[:, 3:] == 0.0).all(axis=1))
    assert any(driving[0] < place < driving[-1] for place in rests)
    assert_within(MOBILE, START, sent)


def test_between_two_tasks_the_base_rests(bench, tmp_path):
    (tmp_path / "tasks.txt").write_text("1\n2\n")
    bench.arm = MobileArm()
    bench.policy = Driver(bench.arm.embodiment)
    bench.run(task=None, task_file=str(tmp_path / "tasks.txt"))
    sent = np.array(bench.arm.sent)
    assert_within(MOBILE, START, sent)
    rests = np.flatnonzero((sent[:, 3:] == 0.0).all(axis=1))
    assert rests[-1] == len(sent) - 1
    assert any(10 < place < len(sent) - 20 for place in rests)


def test_a_base_that_does_not_follow_is_no_tracking_error(bench):
    bench.arm = MobileArm(stuck_base=True)
    bench.policy = Driver(bench.arm.embodiment)
    bench.run()
    assert bench.episode()["outcome"] == "max_steps"


def test_a_name_of_a_speed_needs_the_kind(bench):
    joints = (*ARM.joints, Joint("base_forward", "m", -0.5, 0.5, 0.5, 1.0))
    bench.arm = Arm(embodiment=replace(ARM, joints=joints))
    with pytest.raises(Exception, match=r"base_forward; a mobile base") as caught:
        bench.runner()
    assert "Joint.base(name, unit, speed, acceleration)" in str(caught.value)
