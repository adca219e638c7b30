"""From the last command to the one that holds: what an arm is sent in a stop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fluxvla_core.ros2.stop_motion import Motion, braking_commands, hold_target
from fluxvla_core.spec import EmbodimentSpec, Joint

SPEC = EmbodimentSpec(
    "arm",
    (
        Joint("elbow", "rad", -1.0, 1.0, 1.0, 1.0),
        Joint("wrist", "rad", -2.0, 2.0, 1.0, 1.0),
        Joint("grip", "normalized", 0.0, 1.0, 1.0, 1.0, kind="gripper", open=1.0, closed=0.0),
    ),
    (),
    50.0,
)


STILL = np.zeros(3)


def test_an_arm_that_follows_holds_its_last_command():
    last = np.array([0.5, -0.5, 0.0])

    np.testing.assert_array_equal(hold_target(SPEC, last, last + 0.1, STILL), last)


def test_a_joint_that_was_blocked_holds_where_it_is_and_a_gripper_goes_on_gripping():
    last = np.array([0.5, -0.5, 0.0])
    state = np.array([0.1, -0.5, 0.6])

    np.testing.assert_array_equal(hold_target(SPEC, last, state, STILL), [0.1, -0.5, 0.0])


def test_a_joint_on_its_way_to_its_command_is_not_sent_back_and_one_that_leaves_it_is():
    last, state = np.array([0.5, -0.5, 0.0]), np.array([0.1, -0.1, 0.0])
    moved = np.array([0.3, 0.3, 0.0])

    np.testing.assert_array_equal(hold_target(SPEC, last, state, moved), [0.5, -0.1, 0.0])


def test_metres_are_not_radians():
    slide = replace(SPEC.joints[0], kind="prismatic", unit="m")
    spec = replace(SPEC, joints=(slide, *SPEC.joints[1:]))

    target = hold_target(spec, np.zeros(3), np.array([0.03, 0.03, 0.0]), STILL)
    np.testing.assert_array_equal(target, [0.03, 0.0, 0.0])


def test_a_blocked_joint_beyond_its_limit_is_held_at_the_limit():
    target = hold_target(SPEC, np.zeros(3), np.array([1.2, 0.0, 0.0]), STILL)

    np.testing.assert_array_equal(target, [1.0, 0.0, 0.0])


def assert_kept(path, joints=SPEC.joints):
    """Commands ``(N, 3)`` in a row keep speed and acceleration."""
    speed = np.diff(path, axis=0) * SPEC.rate_hz
    push = np.diff(speed, axis=0) * SPEC.rate_hz
    for column, joint in enumerate(joints):
        assert np.abs(speed[:, column]).max() <= joint.velocity, joint.name
        assert np.abs(push[:, column]).max() <= joint.acceleration, joint.name


def test_a_joint_at_rest_is_led_to_where_it_is_within_the_limits():
    last = np.array([0.5, -0.5, 0.0])
    target = np.array([0.3, -0.5, 0.0])

    way = braking_commands(SPEC, last, last, 0.02, target)

    np.testing.assert_array_equal(way[-1], target)
    assert_kept(np.vstack([last, last, way, way[-1], way[-1]]))
    assert len(way) < 50 * (2 * 0.2**0.5 + 0.1), "about the least time"


def test_an_arm_at_rest_that_follows_is_sent_its_last_command_once():
    last = np.array([0.5, -0.5, 0.0])

    np.testing.assert_array_equal(braking_commands(SPEC, last, last, 0.02, last), [last])


def test_an_arm_in_motion_brakes_and_a_blocked_joint_is_not_pushed_on():
    before, last = np.array([0.0, 0.0, 0.5]), np.array([0.01, 0.01, 0.51])
    target = np.array([-0.3, 0.01, 0.51])

    way = braking_commands(SPEC, last, before, 0.02, target)

    assert_kept(np.vstack([before, last, way, way[-1], way[-1]])[:, 1:], SPEC.joints[1:])
    assert way[-1, 1] > 0.1
    assert way[:, 0].max() <= last[0]
    np.testing.assert_array_equal(way[-1, 0], -0.3)
    assert_kept(np.vstack([last, last, way])[:, :1], SPEC.joints[:1])


def test_commands_that_came_one_by_one_are_no_motion():
    motion = Motion()
    motion.sent(np.zeros(3))

    (way,) = motion.stop_commands(SPEC, np.zeros(3), None)

    np.testing.assert_array_equal(way, np.zeros(3))


@pytest.mark.parametrize("late_s", [0.0, 0.007])
def test_a_motion_is_gone_on_from_at_the_speed_that_it_has(monkeypatch, late_s):
    """However late a single command was, those of a tick are a period apart."""
    now = [100.0]
    monkeypatch.setattr("fluxvla_core.ros2.stop_motion.time.monotonic", lambda: now[0])
    motion, sent = Motion(), [np.full(3, 0.5), np.full(3, 0.51)]
    motion.sent(sent[0])
    now[0] += 0.02 + late_s
    motion.sent(sent[1])
    now[0] += 0.02

    way = motion.stop_commands(SPEC, sent[1], None)

    assert_kept(np.vstack([*sent, way, way[-1]]))
    assert len(way) > 20
    assert len(motion.stop_commands(SPEC, way[-1], None)) == 1, "it was stopped"
