"""The runner on the simulated ALOHA: an expert's motion gets through the limits as it is."""

from __future__ import annotations

import json

import numpy as np
import pytest
from fluxvla_aloha import embodiment
from fluxvla_aloha.runner import AlohaInferenceRunner

from fluxvla_core import RUNNERS, build_runner_from_cfg
from fluxvla_core.errors import ConfigError
from fluxvla_core.operators import Frame, RunContext, SimulatedClock
from fluxvla_core.testing import InferenceRunnerConformance

SPEC = embodiment.aloha_spec(cameras=())
START_POSE = embodiment.start_pose("viperx300")


class TestConformance(InferenceRunnerConformance):
    entry_point = "AlohaInferenceRunner"
    spec = SPEC


class Still:
    """Two arms in memory."""

    api = "1.0"
    embodiment = SPEC

    def __init__(self):
        self.clock = SimulatedClock()
        self.pose = np.array(START_POSE)

    def connect(self):
        return

    def get_frame(self):
        return Frame(self.pose.copy(), {}, {"state": self.clock.now()})

    def send_action(self, action):
        self.pose = np.array(action)
        self.clock.advance(0.02)

    def stop(self):
        return

    def close(self):
        return


class Closing:
    """Moves the grippers to a value and keeps the arms where they are."""

    embodiment, action_rate_hz, horizon = SPEC, 10.0, 10

    def __init__(self, value):
        self.value = value

    def reset(self, seed):
        return

    def predict_action(self, observation):
        chunk = np.repeat(observation["qpos"][None].astype(float), 10, axis=0)
        chunk[:, embodiment.GRIPPERS] = self.value
        return chunk


def run(tmp_path, operator, policy, **arguments):
    table = {
        "type": "AlohaInferenceRunner",
        "task_descriptions": {"1": "close both grippers"},
        "operator": operator,
        "policy": policy,
        "record_fps": None,
        "max_publish_step": 50,
        **arguments,
    }
    context = RunContext(config={}, section="inference", work_dir=tmp_path, task="1")
    runner = build_runner_from_cfg(table, context)
    runner.run_setup()
    return runner, runner.run()


def test_it_is_found_by_its_name():
    assert RUNNERS.get("AlohaInferenceRunner") is AlohaInferenceRunner


def test_the_one_in_real_time_asks_for_a_policy_that_goes_on_from_a_chunk(tmp_path):
    with pytest.raises(ConfigError, match="chunk_joining is 'rtc', and Closing cannot continue"):
        run(tmp_path, Still(), Closing(0.5), type="AlohaRTCInferenceRunner")
    policy = Closing(0.5)
    policy.continue_action = lambda observation, rest: policy.predict_action(observation)

    _, result = run(tmp_path, Still(), policy, type="AlohaRTCInferenceRunner")

    assert result["outcome"] == "max_steps"


@pytest.mark.parametrize(("threshold", "ends_at"), [(None, 0.04), (0.05, 0.0)])
def test_nearly_closed_grippers_are_closed_if_asked_for(tmp_path, threshold, ends_at):
    operator = Still()

    run(tmp_path, operator, Closing(0.04), gripper_threshold=threshold)

    np.testing.assert_allclose(operator.pose[list(embodiment.GRIPPERS)], ends_at, atol=1e-6)


def test_it_goes_to_the_start_pose_if_asked_for(tmp_path):
    operator = Still()
    operator.pose = np.zeros(14)

    run(tmp_path, operator, Closing(1.0), prepare_pose=START_POSE)

    np.testing.assert_allclose(operator.pose, START_POSE, atol=1e-6)


class Replay:
    """An expert's plan, as actions at 10 Hz."""

    action_rate_hz, horizon = 10.0, 5

    def __init__(self, spec, plan):
        self.embodiment = spec
        self.actions = plan[4::5]

    def reset(self, seed):
        self.at = 0

    def predict_action(self, observation):
        rows = self.actions[self.at : self.at + 5]
        self.at += 5
        return np.vstack([rows, np.repeat(self.actions[-1:], 5 - len(rows), axis=0)])


def test_an_experts_motion_passes_the_limits_and_does_the_task(tmp_path):
    pytest.importorskip("mujoco")
    operators = pytest.importorskip("fluxvla_sim.operators")
    from fluxvla_sim.aloha.cube import Expert, sample_cube

    operator = operators.AlohaSimOperator(seed=11, height=48, width=64)
    plan = Expert().plan("transfer_cube", sample_cube(11))
    policy = Replay(operator.embodiment, plan)

    _, result = run(
        tmp_path,
        operator,
        policy,
        max_publish_step=300,
        task_descriptions={"1": "hand the cube over to the left arm"},
    )

    assert result["success"] is True
    summary = json.loads((tmp_path / "inference" / "001-1" / "episode.json").read_text())
    assert sum(sum(c.values()) for c in summary["clamps"].values()) < 0.05 * 14 * result["steps"]
