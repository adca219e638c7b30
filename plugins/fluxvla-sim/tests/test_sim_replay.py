"""A recorded episode in MuJoCo: its actions in the same world, and its robot for a policy."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fluxvla_aloha.operator import AlohaOperator
from fluxvla_sim.expert import SimExpert
from fluxvla_sim.operators import AlohaSimOperator
from fluxvla_ur.operator import UROperator

from fluxvla_core.operators import BaseInferenceRunner, RunContext
from fluxvla_core.results import open_recording
from fluxvla_core.testing.ros2 import ros_domain

__all__ = ["ros_domain"]
pytest.importorskip("rosbags")

TASKS = {"1": "pick up the cube with the right arm and hold it"}


def simulation() -> AlohaSimOperator:
    return AlohaSimOperator(task="lift_hold", seed=3, camera_names=("top",), height=48, width=64)


def run(root: Path, operator: Any, policy: Any, steps: int, **more: Any) -> Any:
    runner = BaseInferenceRunner(
        context=RunContext(work_dir=root, task="1"),
        operator=operator,
        policy=policy,
        task_descriptions=TASKS,
        max_publish_step=steps,
        record=str(root),
        record_fps=10,
        **({"execute_horizon": 5} | more),
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


# A machine that runs tests stalls; what a real robot is stopped for is not what is tested here.
PATIENT = {"height": 48, "width": 64, "connect_timeout_s": 30.0, "max_age_s": 10.0}
GATES = {"max_age_s": 10.0, "max_skew_s": 5.0, "starvation_s": 10.0}
ROBOTS = {
    "aloha": lambda: AlohaOperator(arms="viperx300", camera_names=("top",), **PATIENT),
    "ur5e": lambda: UROperator(camera_names=("front",), **PATIENT),
}
JOINERS = ("synchronous", "latest_only", "temporal_ensemble", "overlap", "rtc")


class Swinger(Follower):
    """Answers about 30 times a second, which no stream's rate divides."""

    action_rate_hz = 30.0

    def predict_action(self, observation: Any) -> np.ndarray:
        here = observation["qpos"][: self.embodiment.dim].astype(np.float64)
        way = np.zeros(self.embodiment.dim)
        way[0] = 0.05
        return here + np.linspace(0, 1, 10)[:, None] * way

    def continue_action(self, observation: Any, rest: Any) -> np.ndarray:
        return self.predict_action(observation)


def record_in_real_time(root: Path, robot: str, joining: str) -> Path:
    """Drive a simulation behind ROS 2, whose streams have rates of their own; the recording."""
    code = "import sys; from fluxvla_core.cli.main import main; sys.exit(main())"
    cameras = "top" if robot == "aloha" else "front"
    rates = ["--camera-hz", "17", "--state-hz", "90", "--latency", f"{cameras}=0.03"]
    size = ["--height", "48", "--width", "64", "--cameras", cameras]
    command = [sys.executable, "-c", code, "sim", robot, "--ros2", *size, *rates]
    simulator = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        operator = ROBOTS[robot]()
        run(
            root, operator, Swinger(operator.embodiment), 120,
            chunk_joining=joining, safety=GATES, execute_horizon=None,
        )  # fmt: skip
    finally:
        simulator.kill()
        simulator.wait(30.0)
    return root / "001-1"


def replay(root: Path, recording: Path, joining: str, realtime: bool) -> Any:
    table = {"type": "ReplayOperator", "recording": str(recording), "realtime": realtime}
    policy = Swinger(open_recording(recording).embodiment)
    more: dict[str, Any] = {"chunk_joining": joining, "execute_horizon": None}
    return run(root, table, policy, 1000, safety=GATES, **more)


@pytest.mark.realtime
def test_what_was_recorded_in_real_time_is_replayed_stepped_and_in_real_time(ros_domain, tmp_path):
    recording = record_in_real_time(tmp_path / "live", "aloha", "latest_only")
    for realtime in (False, True):
        again = replay(tmp_path / str(realtime), recording, "latest_only", realtime)
        assert again.summary()["outcome"] == "done"


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("recorded_with", JOINERS)
def test_every_recording_is_replayed_with_every_joiner(ros_domain, tmp_path, robot, recorded_with):
    recording = record_in_real_time(tmp_path / "live", robot, recorded_with)
    for joining in JOINERS:
        for realtime in (False, True):
            again = replay(tmp_path / f"{joining}{realtime}", recording, joining, realtime)
            assert again.summary()["outcome"] == "done"
