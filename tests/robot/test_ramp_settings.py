"""The way to the start pose, and what a config may set."""

from __future__ import annotations

import numpy as np
import pytest

from fluxvla_core.control.limits import CommandLimiter
from fluxvla_core.control.safety import SafetySettings
from fluxvla_core.control.sender import ramp
from fluxvla_core.errors import ConfigError
from fluxvla_core.spec import EmbodimentSpec, Joint

ARM = EmbodimentSpec(
    "arm", (Joint("a", "rad", -3, 3, 2, 10), Joint("b", "rad", -3, 3, 1, 20)), (), 50
)


def limiter(*pose):
    made = CommandLimiter(ARM, 0.02)
    made.start(pose)
    return made


def test_a_ramp_is_a_straight_line_that_arrives_exactly():
    rows = ramp(limiter(0.0, 1.0), [2.0, 0.0], 0.25)

    np.testing.assert_array_equal(rows[-1], [2.0, 0.0])
    np.testing.assert_allclose(rows[:, 0] / 2.0, 1.0 - rows[:, 1], atol=1e-12)
    assert np.all(np.diff(rows[:, 0]) > 0)


def test_it_is_as_fast_as_its_slowest_joint_may_go():
    rows = ramp(limiter(0.0, 1.0), [2.0, 0.0], 0.25)

    speed = np.abs(np.diff(rows, axis=0)) * 50
    assert speed[:, 0].max() == pytest.approx(0.5, rel=1e-3)
    assert speed[:, 1].max() <= 0.25


@pytest.mark.parametrize("share", [0.25, 1.0])
def test_the_limiter_passes_it_unchanged(share):
    made = limiter(0.0, 1.0)
    rows = ramp(made, [2.0, 0.0], share)

    commands, clamps = made.run(rows, share)

    np.testing.assert_allclose(commands, rows, atol=1e-12)
    assert not any(clamps)


def test_where_the_arm_is_there_already_nothing_is_sent():
    assert ramp(limiter(0.5, 0.5), [0.5, 0.5], 0.25).shape == (0, 2)


@pytest.mark.filterwarnings("error")
def test_a_difference_below_rounding_is_no_way_to_go():
    """The smallest float above 0: dividing a speed by it overflows."""
    made = limiter(0.0, 0.5)
    assert ramp(made, [5e-324, 0.5], 0.25).shape == (0, 2)
    rows = ramp(made, [5e-324, 0.0], 0.25)
    assert np.isfinite(rows).all()
    np.testing.assert_array_equal(rows[-1], [5e-324, 0.0])
    assert np.abs(np.diff(rows[:, 1])).max() * 50 <= 0.25


@pytest.mark.filterwarnings("error")
def test_a_way_that_is_barely_there_is_gone_in_one_command():
    np.testing.assert_array_equal(ramp(limiter(0.0, 0.5), [1e-15, 0.5], 0.25), [[1e-15, 0.5]])


def test_a_pose_that_cannot_be_is_refused():
    with pytest.raises(ConfigError, match="prepare_pose puts b at 4, outside its limits"):
        ramp(limiter(0.0, 0.0), [0.0, 4.0], 0.25)


def test_defaults_are_used_where_nothing_is_said():
    assert SafetySettings.of(None) == SafetySettings()
    assert SafetySettings.of({"jump_s": 2}).jump_s == 2
    same = SafetySettings(excess=0.5)
    assert SafetySettings.of(same) is same


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"jump": 1}, "safety has no setting 'jump'; did you mean jump_s?"),
        ({"colour": 1}, "safety has no setting 'colour'; there are velocity_scale, "),
        ({"jump_s": -1}, "safety.jump_s must be a positive number, got -1"),
        ({"jump_s": 0}, "safety.jump_s must be a positive number, got 0"),
        ({"excess": float("inf")}, "safety.excess must be a positive number, got inf"),
        ({"excess": True}, "safety.excess must be a positive number, got True"),
        ({"max_age_s": "long"}, "safety.max_age_s must be a positive number, got 'long'"),
        ({"ramp_scale": 1.5}, "safety.ramp_scale must be above 0 and at most 1, got 1.5"),
        ("off", "safety must be a table, got 'off'"),
        (False, "safety must be a table, got False"),
    ],
)
def test_what_makes_no_sense_is_refused_and_nothing_turns_a_rule_off(value, message):
    with pytest.raises(ConfigError, match=message.replace("?", r"\?")):
        SafetySettings.of(value)
