"""Joints that state a jerk limit: what is sent keeps it too, and the arm always comes to rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fluxvla_core.control.limits import CommandLimiter
from fluxvla_core.errors import ConfigError
from fluxvla_core.spec import EmbodimentSpec, Joint

ELBOW = Joint("elbow", "rad", -1.0, 1.5, 2.0, 10.0, jerk=100.0)
SLIDE = Joint("slide", "m", 0.0, 0.4, 0.5, 3.0, kind="prismatic")
ARM = EmbodimentSpec("arm", (ELBOW, SLIDE), (), 50.0)


def assert_within(spec: EmbodimentSpec, start, commands, dt: float) -> None:
    """Recompute all derivatives from the positions alone, as a receiver would."""
    path = np.vstack([start, start, start, commands])
    speed = np.diff(path, axis=0) / dt
    push = np.diff(speed, axis=0) / dt
    jerk = np.diff(push, axis=0) / dt
    # A position is rounded, and every difference divides what that leaves by the period.
    rounding = 4 * np.spacing(np.abs(path).max()) / dt**3
    for index, joint in enumerate(spec.joints):
        assert path[:, index].min() >= joint.lower
        assert path[:, index].max() <= joint.upper
        assert np.abs(speed[:, index]).max() <= joint.velocity
        assert np.abs(push[:, index]).max() <= joint.acceleration
        assert np.abs(jerk[:, index]).max() <= (joint.jerk or np.inf) + rounding


@st.composite
def joints(draw):
    lower, width = draw(st.floats(-7, 7)), draw(st.floats(1e-3, 13))
    velocity, push = draw(st.floats(0.05, 10)), draw(st.floats(0.1, 100))
    # Over a second of smoothing is refused, so a jerk limit is at least twice the acceleration's.
    jerk = push * draw(st.floats(2.2, 300))
    return Joint("j", "rad", lower, lower + width, velocity, push, jerk=jerk)


@settings(max_examples=300, deadline=None)
@given(
    joint=joints(),
    dt=st.sampled_from([0.002, 0.008, 0.02, 1 / 30, 0.1]),
    place=st.floats(0, 1),
    seed=st.integers(0, 2**32 - 1),
    hold=st.integers(1, 40),
    share=st.floats(0.05, 1),
)
def test_any_motion_can_be_braked_within_all_limits(joint, dt, place, seed, hold, share):
    """Targets that dwell, so that the arm gets up to speed, at and beyond both limits."""
    spec = EmbodimentSpec("one", (joint,), (), 1 / dt)
    start = np.clip(joint.lower + place * (joint.upper - joint.lower), joint.lower, joint.upper)
    rng = np.random.default_rng(seed)
    wishes = np.repeat(rng.uniform(joint.lower - 0.5, joint.upper + 0.5, 6), hold)
    limiter = CommandLimiter(spec, dt)
    limiter.start([start])

    commands = [
        limiter.step([wish], share if i % 50 > 25 else 1.0)[0] for i, wish in enumerate(wishes)
    ]
    stop = limiter.rest()
    for _ in range(limiter.longest_stop):
        commands.append(limiter.brake())

    assert limiter.at_rest
    np.testing.assert_array_equal(commands[-1], commands[-2])
    np.testing.assert_array_equal(commands[-1], stop)
    assert_within(spec, [start], np.array(commands), dt)


def test_a_target_is_reached_to_the_last_bit_and_without_overshoot():
    limiter = CommandLimiter(ARM, 0.02)
    limiter.start([0.1, 0.2])

    commands, clamps = limiter.run(np.repeat([[0.7, 0.3]], 80, axis=0))

    np.testing.assert_array_equal(commands[-1], [0.7, 0.3])
    assert limiter.at_rest
    assert np.diff(commands, axis=0).min() >= 0
    assert clamps[-1] == []
    reasons = {clamp.reason for row in clamps for clamp in row if clamp.joint == "elbow"}
    assert reasons == {"velocity", "acceleration", "jerk"}
    assert_within(ARM, [0.1, 0.2], commands, 0.02)


def test_a_motion_within_the_limits_is_half_the_smoothing_late():
    limiter = CommandLimiter(EmbodimentSpec("one", (replace(ELBOW, upper=9.0),), (), 50), 0.02)
    limiter.start([0.0])
    ramp = (np.arange(200) * 0.02)[:, None]

    commands, _ = limiter.run(ramp)

    # 2 * 10 / 100 s of smoothing: 10 commands.
    np.testing.assert_allclose(ramp[100:] - commands[100:], 1.0 * 4.5 * 0.02, atol=1e-9)


def test_joints_without_a_limit_and_limits_that_cannot_be_broken_change_nothing():
    """At 50 Hz an acceleration of 10 rad/s^2 cannot change by more than 1,000 rad/s^3."""
    rng = np.random.default_rng(0)
    wishes = rng.uniform(-2, 2, (300, 2))
    plain = [replace(joint, jerk=jerk) for joint, jerk in ((ELBOW, None), (SLIDE, None))]
    free = replace(ARM, joints=(replace(ELBOW, jerk=1001.0), SLIDE))
    sent = []
    for spec in (replace(ARM, joints=tuple(plain)), free):
        limiter = CommandLimiter(spec, 0.02)
        limiter.start([0.1, 0.2])
        sent.append(limiter.run(wishes)[0])
    limiter = CommandLimiter(ARM, 0.02)
    limiter.start([0.1, 0.2])

    np.testing.assert_array_equal(sent[0], sent[1])
    np.testing.assert_array_equal(limiter.run(wishes)[0][:, 1], sent[0][:, 1])


def test_what_was_never_sent_is_forgotten():
    limiter = CommandLimiter(ARM, 0.02)
    limiter.start([0.1, 0.2])
    limiter.run(np.repeat([[0.7, 0.3]], 10, axis=0))
    kept = limiter.snapshot()
    first = limiter.run(np.repeat([[-0.5, 0.0]], 10, axis=0))[0]
    limiter.restore(kept)

    np.testing.assert_array_equal(limiter.run(np.repeat([[-0.5, 0.0]], 10, axis=0))[0], first)


def test_a_motion_that_somebody_else_sent_is_gone_on_from():
    sent = np.array([[0.1, 0.2], [0.12, 0.2]])
    limiter = CommandLimiter(ARM, 0.02)
    limiter.resume(sent[1], sent[0], 0.02)
    stops = [limiter.brake() for _ in range(limiter.longest_stop)]

    path = np.vstack([sent[0] - [0.04, 0.0], sent[0] - [0.02, 0.0], sent, stops])
    jerk = np.diff(path, 3, axis=0)[:, 0] / 0.02**3
    assert np.abs(jerk).max() <= 100.0 * (1 + 1e-6)
    assert limiter.at_rest


def test_a_joint_that_halts_stays_and_the_others_brake():
    limiter = CommandLimiter(ARM, 0.02)
    limiter.start([0.1, 0.2])
    before = limiter.run(np.repeat([[0.9, 0.4]], 12, axis=0))[0]
    limiter.halt(np.array([True, False]))

    stops = np.array([limiter.brake() for _ in range(limiter.longest_stop)])

    np.testing.assert_array_equal(stops[:, 0], before[-1, 0])
    assert stops[-1, 1] > before[-1, 1]


def test_a_limit_that_makes_commands_a_second_late_is_refused():
    spec = replace(ARM, joints=(replace(ELBOW, jerk=10.0), SLIDE))
    with pytest.raises(
        ConfigError, match=r"elbow: a jerk of at most 10 rad/s\^3 takes 2 s to turn"
    ):
        CommandLimiter(spec, 0.02)
