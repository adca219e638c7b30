"""Low-pass, gripper snap, and what they say of robots that they do not fit."""

from __future__ import annotations

import numpy as np
import pytest

from fluxvla_core.control.filters import LowPass, SnapGripper
from fluxvla_core.errors import ConfigError
from fluxvla_core.spec import EmbodimentSpec, Joint


def gripper(name, opened, closed):
    low, high = min(opened, closed), max(opened, closed)
    return Joint(name, "normalized", low, high, 1, 1, kind="gripper", open=opened, closed=closed)


ARM = EmbodimentSpec(
    "arm",
    (
        Joint("elbow", "rad", -1.0, 1.0, 1.0, 1.0),
        gripper("hand", 1.0, 0.0),
        Joint("wrist", "rad", -1.0, 1.0, 1.0, 1.0),
        gripper("claw", 0.0, 255.0),
    ),
    (),
    50.0,
)


def bound(each):
    each.bind(ARM)
    return each


def test_all_grippers_are_snapped_each_with_its_polarity():
    snap = bound(SnapGripper(0.1))

    np.testing.assert_array_equal(snap(np.array([0.05, 0.05, 0.05, 254.95])), [0.05, 0, 0.05, 255])
    np.testing.assert_array_equal(snap(np.array([0.0, 0.15, 0.0, 0.05])), [0, 0.15, 0, 0.05])


def test_grippers_can_be_named_and_opened_too():
    snap = bound(SnapGripper(0.1, open_threshold=0.2, joints=["hand"]))

    np.testing.assert_array_equal(snap(np.array([0, 0.85, 0, 254.95])), [0, 1, 0, 254.95])
    np.testing.assert_array_equal(snap(np.array([0, 0.05, 0, 1])), [0, 0, 0, 1])


def test_what_a_filter_was_given_is_not_changed():
    action = np.array([0.05, 0.05, 0.05, 254.95])
    low_pass = LowPass(0.5)
    low_pass.reset(np.zeros(4))
    for each in (bound(SnapGripper(0.1)), low_pass):
        each(action)
    np.testing.assert_array_equal(action, [0.05, 0.05, 0.05, 254.95])


def test_a_low_pass_goes_a_share_of_the_way_from_where_the_episode_begins():
    smooth = bound(LowPass(0.25))
    smooth.reset(np.array([1.0, 1.0, 1.0, 1.0]))

    np.testing.assert_allclose(smooth(np.zeros(4)), 0.75)
    np.testing.assert_allclose(smooth(np.zeros(4)), 0.75**2)
    smooth.reset(np.zeros(4))
    np.testing.assert_array_equal(smooth(np.zeros(4)), 0.0)


def test_a_low_pass_of_some_joints_leaves_the_others():
    smooth = bound(LowPass(0.5, joints=["wrist", "elbow"]))
    smooth.reset(np.zeros(4))

    np.testing.assert_array_equal(smooth(np.ones(4)), [0.5, 1.0, 0.5, 1.0])


def test_a_constant_target_is_reached_and_stays():
    smooth = bound(LowPass(0.3))
    smooth.reset(np.zeros(4))
    for _ in range(200):
        out = smooth(np.full(4, 0.7))
    np.testing.assert_allclose(out, 0.7)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: LowPass(0), "LowPass: share must be above 0 and at most 1, got 0"),
        (lambda: LowPass(1.5), "LowPass: share must be above 0 and at most 1, got 1.5"),
        (lambda: SnapGripper(-1), "SnapGripper: threshold must not be negative, got -1"),
        (lambda: SnapGripper(float("nan")), "threshold must not be negative, got nan"),
        (lambda: SnapGripper(open_threshold=-1), "open_threshold must not be negative, got -1"),
        (
            lambda: bound(LowPass(0.5, joints=["elbo"])),
            "LowPass: there is no joint 'elbo'; did you mean 'elbow'?",
        ),
        (
            lambda: bound(LowPass(0.5, joints=["x"])),
            "LowPass: there is no joint 'x'; there are elbow, hand, wrist, claw",
        ),
        (
            lambda: bound(SnapGripper(joints=["wrist"])),
            "SnapGripper: there is no joint 'wrist'; there are hand, claw",
        ),
    ],
)
def test_what_does_not_fit_is_said_before_anything_moves(make, message):
    with pytest.raises(ConfigError) as caught:
        make()
    assert message in str(caught.value)


def test_an_arm_without_grippers_has_nothing_to_snap():
    spec = EmbodimentSpec("bare", ARM.joints[:1], (), 50.0)

    with pytest.raises(ConfigError, match="SnapGripper: bare has no gripper"):
        SnapGripper().bind(spec)
