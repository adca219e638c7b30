"""Actions before any I/O, and the action that holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fluxvla_core.errors import Rejected
from fluxvla_core.ros2.actions import checked_action, hold_target
from fluxvla_core.spec.embodiment import EmbodimentSpec, Joint

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


def test_a_good_action_is_copied():
    action = np.array([0.1, 0.2, 0.3])
    checked = checked_action(SPEC, action)

    np.testing.assert_array_equal(checked, action)
    assert not np.shares_memory(checked, action)
    assert checked_action(SPEC, [1, 2, 1]).dtype == np.float64


@pytest.mark.parametrize(
    ("action", "what"),
    [
        ([0.0, 0.0], r"arm takes actions of shape \(3,\), got \(2,\)"),
        ([[0.0, 0.0, 0.0]], r"got \(1, 3\)"),
        ([0.0, np.nan, 0.0], "wrist: the command is nan, not a finite number"),
        ([np.inf, 0.0, 0.0], "elbow: the command is inf"),
        ([1.001, 0.0, 0.0], r"elbow: the command 1.001 rad is outside \[-1, 1\]"),
        ([0.0, 0.0, -0.5], r"grip: the command -0.5 normalized is outside \[0, 1\]"),
    ],
)
def test_a_bad_action_is_refused_and_named(action, what):
    with pytest.raises(Rejected, match=what):
        checked_action(SPEC, action)


STILL = np.zeros(3)


def test_an_arm_that_follows_holds_its_last_command():
    last = np.array([0.5, -0.5, 0.0])

    np.testing.assert_array_equal(hold_target(SPEC, last, last + 0.1, STILL), last)


def test_a_joint_that_was_blocked_holds_where_it_is_and_a_gripper_goes_on_gripping():
    last = np.array([0.5, -0.5, 0.0])
    state = np.array([0.1, -0.5, 0.6])

    np.testing.assert_array_equal(hold_target(SPEC, last, state, STILL), [0.1, -0.5, 0.0])


def test_a_joint_that_may_have_followed_since_it_was_measured_is_not_sent_back():
    last, state = np.array([0.5, -0.5, 0.0]), np.array([0.1, -0.1, 0.0])
    moved = np.array([0.3, 0.0, 0.0])

    np.testing.assert_array_equal(hold_target(SPEC, last, state, moved), [0.5, -0.1, 0.0])


def test_metres_are_not_radians():
    slide = replace(SPEC.joints[0], kind="prismatic", unit="m")
    spec = replace(SPEC, joints=(slide, *SPEC.joints[1:]))

    target = hold_target(spec, np.zeros(3), np.array([0.03, 0.03, 0.0]), STILL)
    np.testing.assert_array_equal(target, [0.03, 0.0, 0.0])


def test_a_blocked_joint_beyond_its_limit_is_held_at_the_limit():
    target = hold_target(SPEC, np.zeros(3), np.array([1.2, 0.0, 0.0]), STILL)

    np.testing.assert_array_equal(target, [1.0, 0.0, 0.0])
