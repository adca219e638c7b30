"""A checkpoint as training writes it, of a tiny model; scenes that several tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from fluxvla_libero.embodiment import libero_spec
from fluxvla_libero.require import is_installed

from fluxvla_core.commands import SilentReporter
from fluxvla_core.operators import Camera
from fluxvla_core.plugins.registry import load_plugin_files

MODEL = '''
import torch
from fluxvla_core import VLAS

@VLAS.register_module()
class DriftingVLA(torch.nn.Module):
    """Drifts with what it sees and with its noise; a fresh one tells its weights apart."""

    action_shape = (4, 7)

    def __init__(self) -> None:
        super().__init__()
        self.gain = torch.nn.Parameter(torch.randn(1))

    def predict_action(self, images, states, noise):
        return self.gain * noise * 0.3 + images.mean() * 0.1
'''


class Listener(SilentReporter):
    def __init__(self):
        self.lines, self.artifacts = [], []

    def info(self, text):
        self.lines.append(text)

    def warn(self, text):
        self.lines.append(f"warning: {text}")

    def artifact(self, kind, path):
        self.artifacts.append((kind, path.name))


@pytest.fixture
def listener():
    return Listener()


@pytest.fixture
def drifting(tmp_path):
    file = tmp_path / "drifting.py"
    file.write_text(MODEL)
    load_plugin_files([str(file)])


@pytest.fixture
def save(drifting):
    """``save(work_dir, spec=…, camera=…)``: writes a checkpoint and gives its path."""
    safetensors = pytest.importorskip("safetensors.torch")
    torch = pytest.importorskip("torch")
    from fluxvla_core.checkpoints.writer import CheckpointWriter

    def row(width: int) -> dict:
        low, high = [-1.0] * width, [1.0] * width
        same = {"mean": [0.0] * width, "std": [1.0] * width}
        return {**same, "min": low, "max": high, "q01": low, "q99": high}

    def make(work_dir: Path, spec=None, camera="agentview", rate=20.0, key="private") -> Path:
        spec = spec or libero_spec([Camera(camera, 32, 48)])
        transforms = [
            {"type": "ResizeImages", "height": 16, "width": 24},
            {"type": "NormalizeImages", "means": [[127.5] * 3], "stds": [[127.5] * 3]},
            {"type": "NormalizeStatesAndActions", "norm_type": "mean_std"},
        ]
        dataset = {"type": "ParquetDataset", "img_keys": [camera], "transforms": transforms}
        if key != "private":
            dataset["statistic_name"] = key
        config = {"model": {"type": "DriftingVLA"}, "train_dataloader": {"dataset": dataset}}
        files = {
            "config.resolved.json": {"format": "fluxvla-config-1", "config": config, "origins": {}},
            "dataset_statistics.json": {key: {"proprio": row(spec.state_dim), "action": row(7)}},
            "embodiment.json": spec.to_dict(),
            "policy.json": {"action_rate_hz": rate, "horizon": 4},
            "trainer.json": {"left_out": {}},
        }
        with CheckpointWriter(work_dir, 100, 1) as writer:
            weights = safetensors.save({"gain": torch.tensor([1.0])})
            writer.write_bytes("model.safetensors", weights)
            for name, value in files.items():
                writer.write_json(name, value)
            return writer.commit()

    return make


@pytest.fixture(scope="session")
def libero():
    """Skips where LIBERO cannot be imported."""
    if not is_installed():
        pytest.skip("LIBERO is not installed (fluxvla-libero[libero])")
    from fluxvla_libero.require import require_libero

    return require_libero()


@pytest.fixture(scope="module")
def scene(libero):
    """The scene of libero_object's task 2, the salad dressing: one for a module's tests."""
    from fluxvla_libero.scene import LiberoScene
    from fluxvla_libero.suites import suite_tasks

    made = LiberoScene(suite_tasks("libero_object")[2])
    yield made
    made.close()


@pytest.fixture
def stock(libero, monkeypatch):
    """``stock(task, size=0)``: LIBERO's own environment, as its evaluation makes it."""
    from fluxvla_libero.require import quiet
    from fluxvla_libero.scene import ENV_SEED

    # Tests hide GPUs from torch by an empty text, of which robosuite wants a number.
    if os.environ.get("CUDA_VISIBLE_DEVICES") == "":
        monkeypatch.delenv("CUDA_VISIBLE_DEVICES")

    def make(task, size=0):
        with quiet():
            made = libero.envs.OffScreenRenderEnv(
                bddl_file_name=str(task.bddl), camera_heights=size or 64, camera_widths=size or 64
            )
        if not size:
            for name, observable in made.env._observables.items():
                observable.set_enabled("image" not in name)
        made.seed(ENV_SEED)
        made.reset()
        return made

    return make
