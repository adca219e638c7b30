"""A whole run with an arm that states jerk limits: every command that is sent keeps them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fluxvla_core.control.joiners import METHODS
from fluxvla_core.control.limits import CommandLimiter
from fluxvla_core.errors import SafetyStop
from fluxvla_core.ros2.stop_motion import braking_commands

JERK = 120.0


class Restless:
    """Chunks that agree neither with one another nor with where the arm is."""

    action_rate_hz, horizon = 10.0, 6

    def __init__(self, embodiment, wrong_after):
        self.embodiment, self.wrong_after = embodiment, wrong_after
        self.asked = 0

    def reset(self, seed):
        self.rng = np.random.default_rng(5)

    def predict_action(self, observation):
        self.asked += 1
        chunk = np.repeat(np.asarray(observation["qpos"], dtype=np.float64)[None], 6, axis=0)
        chunk[:, :2] += 0.2 * self.rng.standard_normal(2) + 0.03 * np.arange(1, 7)[:, None]
        chunk[:, 2] = self.rng.uniform(0.2, 0.8)
        if self.asked == self.wrong_after:
            chunk[2, 0] = np.nan
        return np.clip(chunk, [-0.9, -1.9, 0.0], [1.4, 1.9, 1.0])

    def continue_action(self, observation, rest):
        return self.predict_action(observation)


@pytest.fixture
def jerky(bench, make_arm):
    plain = bench.arm.embodiment
    joints = tuple(replace(joint, jerk=JERK) for joint in plain.joints)
    bench.arm = make_arm(embodiment=replace(plain, joints=joints))
    return bench


def jerk_of(bench, sent):
    """The largest of each joint, from the positions alone, as a receiver would reckon it."""
    path = np.vstack([np.repeat([[0.0, 0.0, 0.5]], 3, axis=0), sent])
    return np.abs(np.diff(path, 3, axis=0) * bench.arm.embodiment.rate_hz**3).max(axis=0)


@pytest.mark.parametrize("wrong_after", [None, 4])
@pytest.mark.parametrize("joining", METHODS)
def test_every_command_of_a_run_keeps_the_jerk_limit(jerky, joining, wrong_after):
    """The ramp to the first pose, chunks that disagree, a filter, the end, the stop of a fault."""
    jerky.policy = Restless(jerky.arm.embodiment, wrong_after)
    more = {
        "chunk_joining": joining,
        "prepare_pose": [0.3, -0.2, 0.5],
        "action_filters": [{"type": "LowPass", "share": 0.5}],
        "max_publish_step": 120,
    }
    if wrong_after is None:
        jerky.run(**more)
    else:
        with pytest.raises(SafetyStop, match=r"not finite|NaN|nan"):
            jerky.run(**more)
    sent = np.array(jerky.arm.sent)
    assert len(sent) > 40
    np.testing.assert_allclose(sent[-1], sent[-2], atol=1e-3)
    found = jerk_of(jerky, sent)
    assert found.max() <= JERK * (1 + 1e-6)
    assert found[:2].min() > JERK / 2, "the limit was reached, or nothing is shown"
    jerky.assert_within_limits()


def test_without_the_limit_the_same_run_exceeds_it(bench):
    bench.policy = Restless(bench.arm.embodiment, None)
    bench.run(prepare_pose=[0.3, -0.2, 0.5], max_publish_step=120)
    assert jerk_of(bench, np.array(bench.arm.sent)).max() > 2 * JERK


def test_an_operators_own_stop_keeps_the_other_limits_alone(jerky):
    """It knows two commands, which say nothing of the acceleration; docs/control.md says so."""
    spec = jerky.arm.embodiment
    limiter = CommandLimiter(spec, 1 / spec.rate_hz)
    limiter.start([0.0, 0.0, 0.5])
    sent = [np.array([0.0, 0.0, 0.5])] * 2
    sent += [limiter.step([1.4, 1.9, 1.0], 1.0)[0] for _ in range(20)]
    stop = braking_commands(spec, sent[-1], sent[-2], 1 / spec.rate_hz, sent[-1])
    jerky.assert_within_limits(sent=[*sent, *stop])
    assert jerk_of(jerky, np.array(sent)).max() <= JERK * (1 + 1e-6)
    assert jerk_of(jerky, np.vstack([*sent, *stop])).max() > JERK
