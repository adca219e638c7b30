"""A policy that wants the impossible: what reaches the robot keeps every limit all the same."""

from __future__ import annotations

import numpy as np
import pytest


class Adversary:
    """Jumps, sweeps, spikes and dwells, within and far beyond the limits."""

    action_rate_hz, horizon = 10.0, 3

    def __init__(self, embodiment, seed):
        self.embodiment = embodiment
        self.rng = np.random.default_rng(seed)
        self.chunks = 0

    def reset(self, seed):
        return

    def predict_action(self, observation):
        self.chunks += 1
        joints = self.embodiment.joints
        lower = np.array([j.lower for j in joints])
        upper = np.array([j.upper for j in joints])
        kind = self.rng.integers(5)
        if kind == 0:
            return self.rng.uniform(lower - 1, upper + 1, (3, len(joints)))
        if kind == 1:
            return np.repeat(np.where(self.rng.random(len(joints)) < 0.5, lower, upper)[None], 3, 0)
        if kind == 2:
            return np.linspace(lower - 0.3, upper + 0.3, 3)
        if kind == 3:
            return self.rng.choice([-1e9, 0.0, 1e9], (3, len(joints)))
        return np.repeat(np.asarray(observation["qpos"], dtype=float)[None], 3, 0)


@pytest.mark.parametrize("seed", [0, 1])
def test_hundreds_of_adversarial_chunks(bench, seed):
    bench.policy = Adversary(bench.arm.embodiment, seed)

    bench.run(
        max_publish_step=6000,
        safety={"jump_s": 1e12, "excess": 1e12, "tracking_error": 100},
        execute_horizon=2,
    )

    assert bench.policy.chunks >= 600
    assert len(bench.arm.sent) >= 6000
    bench.assert_within_limits()


@pytest.mark.realtime
def test_an_adversary_on_a_robot_in_real_time(bench, make_arm):
    """Chunks replace each other while they are played, and ticks come when they come."""
    bench.arm = make_arm(realtime=True)
    bench.policy = Adversary(bench.arm.embodiment, 2)

    bench.run(
        max_publish_step=75,
        safety={"jump_s": 1e12, "excess": 1e12, "tracking_error": 100},
        async_execution=True,
    )

    assert bench.policy.chunks >= 40
    bench.assert_within_limits()
