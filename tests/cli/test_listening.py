"""What listens while FluxVLA works: nothing that another machine could connect to.

Trainings are looked at in ``test_stopping.py``, while they run there.
"""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from fluxvla_core.testing.ros2 import ros_domain
from tests.evaluation.conftest import WALKING

from .jobs import linux, outside, seen_outside

__all__ = ["ros_domain"]

pytest.importorskip("torch")
pytestmark = linux


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_a_socket_that_others_can_reach_is_seen() -> None:
    with socket.create_server(("0.0.0.0", 0)) as here:
        assert outside([os.getpid()]) == [f"0.0.0.0:{here.getsockname()[1]}"]


def test_an_evaluation_and_its_workers_open_nothing() -> None:
    Path("walk.py").write_text(
        "eval = dict(type='EvalRunner', policy='expert', episodes=4, record_videos=0,\n"
        "    environment=dict(type='Walk', slow=0.01))\n"
    )
    run = ("run", "--config", "walk.py", "--plugin", str(WALKING), "--work-dir", "work")
    looks, found = seen_outside(*run, "--nproc", "2")
    assert looks > 5
    assert found == set()


@pytest.mark.slow
def test_a_collection_opens_nothing() -> None:
    pytest.importorskip("fluxvla_sim")
    size = ("--height", "48", "--width", "64", "--episodes", "2", "--workers", "2")
    assert seen_outside("collect", "ur5e", "--out", "data", *size)[1] == set()


WAVE_POLICY = """
import numpy as np
from fluxvla_aloha.embodiment import CAMERAS, aloha_spec
from fluxvla_core import POLICIES, Policy


@POLICIES.register_module()
class WavePolicy(Policy):
    embodiment = aloha_spec(CAMERAS[:0], 50.0)
    action_rate_hz, horizon = 10.0, 10

    def reset(self, seed):
        self.side = 1.0

    def predict_action(self, observation):
        self.side = -self.side
        chunk = np.repeat(observation["qpos"][None].astype(float), self.horizon, axis=0)
        chunk[:, 0] += 0.1 * self.side * np.sin(np.linspace(0, np.pi, self.horizon))
        return chunk
"""
WAVE = """
inference = dict(type="AlohaInferenceRunner", task_descriptions={"1": "wave"}, max_publish_step=50,
    policy=dict(type="WavePolicy"), record="recordings",
    operator=dict(type="AlohaSimOperator", camera_names=("top",), height=48, width=64))
"""


@pytest.mark.slow
def test_a_robots_run_its_record_and_its_replay_open_nothing() -> None:
    pytest.importorskip("fluxvla_sim")
    Path("wave.py").write_text(WAVE)
    Path("wave_policy.py").write_text(WAVE_POLICY)
    run = ("run", "--config", "wave.py", "--plugin", "wave_policy.py", "--task", "1")
    assert seen_outside(*run)[1] == set()
    recorded = 'inference.operator={type="ReplayOperator", recording="recordings/001-1"}'
    assert seen_outside(*run, "--record", "replayed", "--set", recorded)[1] == set()


@pytest.mark.slow
def test_a_simulation_over_ros2_opens_no_tcp_port(ros_domain: int) -> None:
    """Its UDP sockets are DDS's; docs/ros2.md says where they are."""
    pytest.importorskip("fluxvla_sim")
    size = ("--height", "48", "--width", "64", "--camera-hz", "5", "--seconds", "3")
    assert seen_outside("sim", "ur5e", "--ros2", *size)[1] == set()
