"""A small model, and checkpoints of it as training writes them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fluxvla_core.plugins.registry import VLAS
from fluxvla_core.spec import Camera, EmbodimentSpec, Joint

torch = pytest.importorskip("torch")
safetensors = pytest.importorskip("safetensors.torch")

ARM = EmbodimentSpec(
    "testarm",
    (
        Joint("shoulder", "rad", -1.0, 1.5, 2.0, 10.0),
        Joint("elbow", "rad", -2.0, 2.0, 3.0, 20.0),
    ),
    (Camera("front", 24, 32),),
    50.0,
)
MEAN, STD = [0.1, -0.2], [0.5, 2.0]


class LittleVLA(torch.nn.Module):
    """Actions = gain * noise + the normalised state; remembers what it was given."""

    def __init__(self, action_dim: int = 2) -> None:
        super().__init__()
        self.gain = torch.nn.Parameter(torch.ones(1))
        self.action_dim = action_dim
        self.batch: dict[str, Any] = {}

    @property
    def action_shape(self) -> tuple[int, int]:
        return 4, self.action_dim

    def predict_action(self, images: Any, states: Any, noise: Any) -> Any:
        self.batch = {"images": images, "states": states, "noise": noise}
        return self.gain * noise + states[:, None, : self.action_dim]


class Plain(torch.nn.Module):
    """A model without noise that takes whatever there is."""

    action_shape = (4, 2)

    def __init__(self) -> None:
        super().__init__()
        self.gain = torch.nn.Parameter(torch.ones(1))

    def predict_action(self, **batch: Any) -> Any:
        self.batch = batch
        return torch.zeros(1, 4, 2) + self.gain


@pytest.fixture(autouse=True)
def models():
    for cls in (LittleVLA, Plain):
        VLAS.register_module()(cls)
    yield
    for cls in (LittleVLA, Plain):
        VLAS.unregister(cls.__name__)


def save(
    work_dir: Path, step: int = 100, gain: float = 2.0, ema: float | None = None, **changes: Any
) -> Path:
    """A checkpoint as training writes it."""
    from fluxvla_core.checkpoints.writer import CheckpointWriter

    row = {"mean": MEAN, "std": STD, "min": [-1, -3], "max": [1, 3], "q01": [-1, -3], "q99": [1, 3]}
    dataset = {
        "type": "ParquetDataset",
        "data_root_path": "gone",
        "img_keys": ["observation.images.front"],
        "transforms": [
            {"type": "ResizeImages", "height": 12, "width": 16},
            {"type": "NormalizeImages", "means": [[127.5] * 3], "stds": [[127.5] * 3]},
            {"type": "StateNoise", "std": 0.5, "state_key": "proprio"},
            {"type": "NormalizeStatesAndActions", "norm_type": "mean_std"},
            {"type": "SampleFlowNoise"},
        ],
        **changes.pop("dataset", {}),
    }
    config = {
        "model": {"type": "LittleVLA"},
        "train_dataloader": {"dataset": dataset},
        **changes.pop("config", {}),
    }
    files = {
        "config.resolved.json": {"format": "fluxvla-config-1", "config": config, "origins": {}},
        "dataset_statistics.json": {"private": {"proprio": row, "action": row}},
        "embodiment.json": ARM.to_dict(),
        "policy.json": {"action_rate_hz": 10.0, "horizon": 4},
        "trainer.json": {"left_out": {}},
        **changes,
    }
    with CheckpointWriter(work_dir, step, 1) as writer:
        writer.write_bytes("model.safetensors", safetensors.save({"gain": torch.tensor([gain])}))
        if ema is not None:
            averaged = safetensors.save({"gain": torch.tensor([ema])})
            writer.write_bytes("ema.safetensors", averaged)
        for name, value in files.items():
            if isinstance(value, bytes):
                writer.write_bytes(name, value)
            elif value is not None:
                writer.write_json(name, value)
        return writer.commit()


def observation(pose=(0.3, -0.4)):
    return {
        "qpos": np.array(pose, np.float32),
        "images": {"front": np.full((24, 32, 3), 255, np.uint8)},
        "task_description": "wave at the camera",
    }


def load(path, **arguments):
    from fluxvla_core.policies.loading import load_policy

    return load_policy(path, **arguments)
