"""What leaves the limiter is within every limit, whatever goes in; and it follows when it may."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fluxvla_core.control.limits import Clamp, CommandLimiter, braking_speed
from fluxvla_core.errors import ConfigError, SafetyStop
from fluxvla_core.spec import EmbodimentSpec, Joint

JOINTS = (
    Joint("shoulder", "rad", -1.0, 1.5, 2.0, 10.0),
    Joint("elbow", "rad", -2.0, 2.0, 3.0, 20.0),
    Joint("jaw", "normalized", 0.0, 1.0, 2.0, 30.0, kind="gripper", open=1.0, closed=0.0),
)
ARM = EmbodimentSpec("testarm", JOINTS, (), 50.0)


def one(lower=-1.0, upper=1.0, velocity=2.0, acceleration=10.0) -> EmbodimentSpec:
    return EmbodimentSpec("one", (Joint("j", "rad", lower, upper, velocity, acceleration),), (), 50)


def assert_within(spec: EmbodimentSpec, start, commands, dt: float) -> None:
    """Recompute speeds and accelerations from the positions alone, as a receiver would."""
    path = np.vstack([start, start, commands])
    speed = np.diff(path, axis=0) / dt
    for index, joint in enumerate(spec.joints):
        assert path[:, index].min() >= joint.lower
        assert path[:, index].max() <= joint.upper
        assert np.abs(speed[:, index]).max() <= joint.velocity
        assert np.abs(np.diff(speed[:, index])).max() / dt <= joint.acceleration


wild = st.floats(-1e6, 1e6, allow_nan=False)
near = st.floats(-3, 3)
edges = st.sampled_from([-2.0, -1.0, 0.0, 1.0, 1.5, 2.0, -1e300, 1e300, 1e-300])
targets = st.lists(st.tuples(*[st.one_of(near, edges, wild)] * 3), min_size=1, max_size=60)
joint = st.builds(
    lambda lower, width, velocity, acceleration: Joint(
        "j", "rad", lower, lower + width, velocity, acceleration
    ),
    st.floats(-7, 7),
    st.floats(1e-3, 13),
    st.floats(0.05, 10),
    st.floats(0.1, 100),
)


@settings(max_examples=400, deadline=None)
@given(chunk=targets, start=st.tuples(st.floats(-1, 1.5), st.floats(-2, 2), st.floats(0, 1)))
def test_adversarial_chunks_never_leave_the_limits(chunk, start):
    limiter = CommandLimiter(ARM, 0.02)
    limiter.start(start)

    commands, _ = limiter.run(np.array(chunk))

    assert_within(ARM, np.array(start), commands, 0.02)


@settings(max_examples=300, deadline=None)
@given(
    joint=joint,
    dt=st.sampled_from([0.002, 0.008, 0.02, 1 / 30, 0.1]),
    place=st.floats(0, 1),
    seed=st.integers(0, 2**32 - 1),
    hold=st.integers(1, 40),
)
def test_every_joint_and_rate_keeps_its_limits(joint, dt, place, seed, hold):
    """Targets that dwell, so that the arm gets up to speed, at and beyond both limits."""
    spec = EmbodimentSpec("one", (joint,), (), 1 / dt)
    start = np.clip(joint.lower + place * (joint.upper - joint.lower), joint.lower, joint.upper)
    rng = np.random.default_rng(seed)
    wishes = np.repeat(rng.uniform(joint.lower - 0.5, joint.upper + 0.5, 6), hold)[:, None]
    limiter = CommandLimiter(spec, dt)
    limiter.start([start])

    commands, _ = limiter.run(wishes)

    assert_within(spec, np.array([start]), commands, dt)


@pytest.mark.parametrize("dt", [0.001, 0.02, 0.1])
def test_thousands_of_random_joints_keep_their_limits(dt):
    """2000 joints, each with limits and an adversary of its own: jumps, dwells, sweeps, spikes."""
    rng = np.random.default_rng(int(dt * 1000))
    count, steps = 2000, 150
    lower = rng.uniform(-7, 7, count)
    upper = lower + 10 ** rng.uniform(-3, 1.1, count)
    speed, push = 10 ** rng.uniform(-1.3, 1, count), 10 ** rng.uniform(-1, 2, count)
    rows = zip(lower, upper, speed, push, strict=True)
    joints = tuple(Joint(f"j{i}", "rad", *map(float, row)) for i, row in enumerate(rows))
    spec = EmbodimentSpec("many", joints, (), 1 / dt)
    start = rng.uniform(lower, upper)
    dwell = rng.integers(1, 60, count)
    turn = np.arange(steps)[:, None] // dwell
    phase = rng.uniform(0, 1, (steps, count))[turn, np.arange(count)]
    wishes = lower - 0.5 + phase * (upper - lower + 1.0)
    wishes[rng.random(wishes.shape) < 0.01] = 1e300
    limiter = CommandLimiter(spec, dt)
    limiter.start(start)

    commands = np.array([limiter.step(row)[0] for row in wishes])

    path = np.vstack([start, start, commands])
    pace = np.diff(path, axis=0) / dt
    assert (path >= lower).all()
    assert (path <= upper).all()
    assert (np.abs(pace) <= speed).all()
    assert (np.abs(np.diff(pace, axis=0)) / dt <= push).all()


@settings(max_examples=150, deadline=None)
@given(chunk=targets, share=st.floats(0.05, 1), stop=st.integers(0, 59))
def test_braking_and_slower_speeds_keep_the_limits_too(chunk, share, stop):
    limiter = CommandLimiter(ARM, 0.02)
    limiter.start([0, 0, 0.5])
    commands = []
    for index, target in enumerate(chunk):
        speed = share if index >= stop else 1.0
        commands.append(limiter.step(target, speed=speed)[0])
    while not limiter.at_rest:
        commands.append(limiter.brake())

    assert_within(ARM, np.array([0, 0, 0.5]), np.array(commands), 0.02)
    assert len(commands) <= len(chunk) + 3.0 / 20.0 / 0.02 + 12


def test_the_braking_speed_is_the_exact_solution():
    """Braking from b(d) covers d, to rounding: nothing is given away, nothing overshoots."""
    rng = np.random.default_rng(0)
    for _ in range(500):
        room, step, dt = rng.uniform(0, 3), rng.uniform(0.01, 1), rng.choice([0.002, 0.02, 0.1])
        speed = float(braking_speed(np.array([room]), np.array([step]), dt)[0])
        covered = 0.0
        while speed > 0:
            covered += speed * dt
            speed -= step
        assert covered == pytest.approx(room, rel=1e-9, abs=1e-12)


def test_no_room_means_no_speed():
    np.testing.assert_array_equal(
        braking_speed(np.array([0.0, -1.0]), np.array([0.1, 0.1]), 0.02), [0.0, 0.0]
    )


def test_a_gentle_motion_passes_unchanged():
    t = np.arange(200) * 0.02
    wave = np.stack([0.3 * (1 - np.cos(t)), -0.4 * (1 - np.cos(t)), 0.5 + 0 * t], axis=1)
    limiter = CommandLimiter(ARM, 0.02)
    limiter.start(wave[0])

    commands, clamps = limiter.run(wave)

    np.testing.assert_array_equal(commands, wave)
    assert clamps == [[]] * 200


@settings(max_examples=150, deadline=None)
@given(chunk=targets, hold=st.integers(1, 12))
def test_what_was_sent_passes_unchanged_when_it_is_wanted_again(chunk, hold):
    """A recorded motion is within the limits, at full speed and in full braking too."""
    recorded, replayed = CommandLimiter(ARM, 0.02), CommandLimiter(ARM, 0.02)
    for limiter in (recorded, replayed):
        limiter.start([0, 0, 0.5])
    commands, _ = recorded.run(np.repeat(np.array(chunk), hold, axis=0))

    again, clamps = replayed.run(commands)

    np.testing.assert_allclose(again, commands, rtol=0, atol=1e-11)
    assert not any(clamp.reason == "position" for row in clamps for clamp in row)


def test_a_step_is_reached_without_overshoot_in_about_the_least_time():
    limiter = CommandLimiter(one(velocity=2.0, acceleration=10.0), 0.02)
    limiter.start([0.0])

    commands, _ = limiter.run(np.full((100, 1), 0.8))

    path = commands[:, 0]
    assert path.max() <= 0.8
    assert np.all(np.diff(path) >= 0)
    arrival = (int(np.argmax(path == 0.8)) + 1) * 0.02
    # 0.2 s to reach 2 rad/s, 0.2 s at it, 0.2 s to stop.
    assert 0.6 <= arrival <= 0.64


def test_a_steady_ramp_is_followed_without_lag():
    limiter = CommandLimiter(one(upper=10.0), 0.02)
    limiter.start([0.0])
    ramp = (np.arange(300) * 0.02 * 1.5)[:, None]

    commands, _ = limiter.run(ramp)

    np.testing.assert_allclose(commands[100:], ramp[100:], atol=1e-9)


def test_an_arm_at_speed_stops_before_its_limit():
    limiter = CommandLimiter(one(velocity=5.0, acceleration=5.0), 0.02)
    limiter.start([-1.0])

    commands, clamps = limiter.run(np.full((200, 1), 50.0))

    assert commands.max() == 1.0
    assert_within(one(velocity=5.0, acceleration=5.0), np.array([-1.0]), commands, 0.02)
    assert clamps[0] == [Clamp("j", 50.0, float(commands[0, 0]), "position")]


@pytest.mark.parametrize(
    ("wishes", "reason"),
    [([[1.2]], "position"), ([[0.5]], "velocity"), ([[0.02]], "acceleration")],
)
def test_each_clamp_names_joint_values_and_reason(wishes, reason):
    limiter = CommandLimiter(one(), 0.02)
    limiter.start([0.0])

    commands, clamps = limiter.run(wishes)

    (found,) = clamps[0]
    assert found == Clamp("j", wishes[0][0], float(commands[0, 0]), reason)
    assert found.given != found.wanted


def test_slowing_down_before_a_limit_is_called_braking():
    limiter = CommandLimiter(one(velocity=2.0, acceleration=2.0), 0.02)
    limiter.start([-1.0])
    fast = -1.0 + np.cumsum(np.minimum(np.arange(1, 70) * 0.0007, 0.035))

    _, clamps = limiter.run(fast[:, None])

    first = next(row for row in clamps if row)
    assert [c.reason for c in first] == ["braking"]


def test_scales_use_a_share_of_the_limits():
    limiter = CommandLimiter(one(), 0.02, velocity_scale=0.5, acceleration_scale=0.1)
    limiter.start([-1.0])

    commands, _ = limiter.run(np.full((200, 1), 1.0))

    slow = one(velocity=1.0, acceleration=1.0)
    assert_within(slow, np.array([-1.0]), commands, 0.02)


@pytest.mark.parametrize("scales", [{"velocity_scale": 0}, {"acceleration_scale": 1.5}])
def test_scales_cannot_lift_a_limit(scales):
    name = next(iter(scales))
    with pytest.raises(ConfigError, match=f"safety.{name} must be above 0 and at most 1"):
        CommandLimiter(ARM, 0.02, **scales)


def test_the_period_must_be_positive():
    with pytest.raises(ConfigError, match="period between commands must be positive, got 0"):
        CommandLimiter(ARM, 0)


def test_an_embodiment_that_takes_deltas_is_refused():
    spec = EmbodimentSpec("d", JOINTS, (), 50.0, action_mode="delta")
    with pytest.raises(ConfigError, match="limits can only be kept for absolute joint targets"):
        CommandLimiter(spec, 0.02)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_not_finite_stops_and_changes_nothing(bad):
    limiter = CommandLimiter(ARM, 0.02)
    limiter.start([0, 0, 0.5])

    with pytest.raises(SafetyStop, match="the command is not finite for elbow, jaw"):
        limiter.run([[0.1, 0, 0.5], [0.1, bad, bad]])
    np.testing.assert_array_equal(limiter.last, [0, 0, 0.5])


def test_a_wrong_shape_stops():
    limiter = CommandLimiter(ARM, 0.02)
    limiter.start([0, 0, 0.5])

    with pytest.raises(SafetyStop, match=r"has shape \(2,\); testarm takes \(3,\)"):
        limiter.step([0.0, 0.0])


def test_nothing_is_commanded_before_the_start():
    with pytest.raises(SafetyStop, match="before the limiter was started"):
        CommandLimiter(ARM, 0.02).step([0, 0, 0])


def test_a_joint_just_beyond_its_limit_starts_at_the_limit():
    limiter = CommandLimiter(ARM, 0.02)
    limiter.start([1.51, 0.0, -0.02])

    np.testing.assert_array_equal(limiter.last, [1.5, 0.0, 0.0])


def test_a_joint_far_beyond_its_limit_does_not_start():
    with pytest.raises(SafetyStop, match=r"shoulder is at 1.7, outside its limits \[-1, 1.5\] rad"):
        CommandLimiter(ARM, 0.02).start([1.7, 0.0, 0.5])


def test_braking_comes_to_rest_and_stays():
    limiter = CommandLimiter(one(), 0.02)
    limiter.start([0.0])
    limiter.run(np.full((20, 1), 1.0))
    assert not limiter.at_rest

    stops = [float(limiter.brake()[0]) for _ in range(12)]

    assert limiter.at_rest
    assert stops[-1] == stops[-2]
    assert np.all(np.diff(stops) >= 0)
