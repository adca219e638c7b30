"""A recorded run of a Diffusion Policy of two observations, asked again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fluxvla_core.policies.benchmark import untrained_policy
from fluxvla_core.results import open_recording
from tests.robot.conftest import ARM, Arm, Bench

pytest.importorskip("rosbags")

MODEL = {
    "type": "DiffusionPolicy",
    "state_dim": 3,
    "action_dim": 3,
    "horizon": 8,
    "n_obs_steps": 2,
    "backbone_width": 8,
    "keypoints": 4,
    "down_dims": (8, 16),
    "diffusion_step_embed_dim": 8,
    "num_inference_steps": 2,
}
DATASET = {
    "type": "ParquetDataset",
    "img_keys": ["observation.images.front"],
    "transforms": [
        {"type": "ResizeImages", "height": 48, "width": 64},
        {"type": "NormalizeImages", "means": [[127.5] * 3], "stds": [[127.5] * 3]},
        {"type": "NormalizeStatesAndActions", "norm_type": "mean_std"},
    ],
}


class Dial(Arm):
    """Sees how often it was commanded: a bright square that moves across."""

    def get_frame(self):
        frame = super().get_frame()
        image, count = frame.images["front"], len(self.sent)
        image[:] = 20
        image[4 * (count // 28) % 20 :, count % 28 : count % 28 + 4] = 250
        return frame


@pytest.mark.parametrize("joining", ["synchronous", "temporal_ensemble"])
def test_the_recorded_robot_gets_the_answers_that_were_given(tmp_path: Path, joining: str) -> None:
    bench = Bench(tmp_path)
    bench.arm = Dial()
    config = {"model": MODEL, "train_dataloader": {"dataset": DATASET}}
    bench.policy = untrained_policy(config, ARM, "cpu", "float32", 3)
    assert (bench.policy.n_obs_steps, bench.policy.horizon) == (2, 7)
    settings = {
        "record": str(tmp_path),
        "chunk_joining": joining,
        "execute_horizon": 3,
        "max_publish_step": 60,
        "safety": {"jump_s": 50, "excess": 50},
    }
    bench.policy.action_rate_hz = 10.0  # five commands for an action
    bench.run(**settings)
    bench.run(**settings, operator={"type": "ReplayOperator", "recording": str(tmp_path / "001-1")})

    live, again = (open_recording(tmp_path / name).chunks() for name in ("001-1", "002-1"))
    assert len(live) == 4
    np.testing.assert_array_equal(again, live)
