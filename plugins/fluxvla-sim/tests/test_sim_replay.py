"""A recorded episode in MuJoCo: its actions in the same world, and its robot for a policy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fluxvla_sim.expert import SimExpert
from fluxvla_sim.operators import AlohaSimOperator

from fluxvla_core.build import RunContext
from fluxvla_core.infer.base_runner import BaseInferenceRunner
from fluxvla_core.record.recording import open_recording

pytest.importorskip("rosbags")

TASKS = {"1": "pick up the cube with the right arm and hold it"}


def simulation() -> AlohaSimOperator:
    return AlohaSimOperator(task="lift_hold", seed=3, camera_names=("top",), height=48, width=64)


def run(root: Path, operator: Any, policy: Any, steps: int) -> Any:
    runner = BaseInferenceRunner(
        context=RunContext(work_dir=root, task="1"),
        operator=operator,
        policy=policy,
        task_descriptions=TASKS,
        execute_horizon=5,
        max_publish_step=steps,
        record=str(root),
        record_fps=10,
    )
    runner.run_setup()
    runner.run()
    return open_recording(root)


class Follower:
    """A policy whose answers follow from what it sees alone."""

    action_rate_hz, horizon = 10.0, 10

    def __init__(self, embodiment: Any) -> None:
        self.embodiment = embodiment

    def reset(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def predict_action(self, observation: Any) -> np.ndarray:
        pixels = observation["images"]["top"].astype(np.float64)
        way = 0.1 * np.sin(pixels.mean((0, 2))[:14]) + 0.02 * self.rng.standard_normal(14)
        way[[6, 13]] = 0.0
        return observation["qpos"] + np.linspace(0, 1, 10)[:, None] * way


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The expert's success."""
    operator = simulation()
    operator.connect()
    expert = SimExpert(action_rate_hz=10, horizon=10)
    expert.enter(operator)
    return run(tmp_path_factory.mktemp("recorded"), operator, expert, 300)


def test_recorded_actions_from_the_same_seed_do_the_same_and_succeed(recorded, tmp_path):
    assert recorded.success is True
    table = {"type": "ReplayPolicy", "recording": str(recorded.path)}

    again = run(tmp_path, simulation(), table, 300)

    np.testing.assert_array_equal(again.commands()[1], recorded.commands()[1])
    np.testing.assert_array_equal(again.states()[1], recorded.states()[1])
    assert again.success is True
    assert again.summary()["outcome"] == recorded.summary()["outcome"] == "done"


def test_the_recorded_robot_asks_the_same_policy_the_same(tmp_path):
    first = run(tmp_path / "a", simulation(), Follower(simulation().embodiment), 100)
    table = {"type": "ReplayOperator", "recording": str(first.path)}

    again = run(tmp_path / "b", table, Follower(simulation().embodiment), 100)

    assert len(first.chunks()) == 4
    np.testing.assert_array_equal(again.chunks(), first.chunks())
    np.testing.assert_array_equal(again.commands()[1], first.commands()[1])
