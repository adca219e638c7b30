"""The walker's plugin file, checkpoints of its model, and a reporter that remembers."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from fluxvla_core.commands import SilentReporter
from fluxvla_core.plugins.registry import load_plugin_files

WALKING = Path(__file__).with_name("walking.py")


class Listener(SilentReporter):
    """A reporter that remembers."""

    def __init__(self):
        self.lines, self.warnings, self.events, self.artifacts = [], [], [], []

    def info(self, text):
        self.lines.append(text)

    def warn(self, text):
        self.warnings.append(text)

    def event(self, kind, **fields):
        self.events.append((kind, fields))

    def artifact(self, kind, path):
        self.artifacts.append((kind, path.name))


@pytest.fixture
def listener():
    return Listener()


@pytest.fixture
def walking():
    """``Walk`` and ``Walker`` are registered, here and in worker processes."""
    load_plugin_files([WALKING])


@pytest.fixture
def checkpoint(tmp_path, monkeypatch):
    """A checkpoint of the walker's model, as training writes it; gives its work dir."""
    torch = pytest.importorskip("torch")
    safetensors = pytest.importorskip("safetensors.torch")
    monkeypatch.setenv("WALKING_MODEL", "1")
    load_plugin_files([WALKING])
    from fluxvla_core.build import build_vla_from_cfg
    from fluxvla_core.checkpoints.writer import CheckpointWriter

    embodiment = sys.modules["fluxvla_plugin_walking"].embodiment
    row = {"mean": [0.0], "std": [1.0], "min": [-3.0], "max": [3.0], "q01": [-3.0], "q99": [3.0]}
    transforms = [
        {"type": "NormalizeImages", "means": [[127.5] * 3], "stds": [[127.5] * 3]},
        {"type": "NormalizeStatesAndActions", "norm_type": "mean_std"},
    ]
    dataset = {"type": "ParquetDataset", "img_keys": ["eye"], "transforms": transforms}
    dataset["data_root_path"] = str(tmp_path / "demonstrations")  # which are not there
    config = {"model": {"type": "Strides"}, "train_dataloader": {"dataset": dataset}}
    files = {
        "config.resolved.json": {"format": "fluxvla-config-1", "config": config, "origins": {}},
        "dataset_statistics.json": {"private": {"proprio": row, "action": row}},
        "embodiment.json": embodiment().to_dict(),
        "policy.json": {"action_rate_hz": 10.0, "horizon": 4},
        "trainer.json": {"left_out": {}},
    }
    with torch.random.fork_rng():
        torch.manual_seed(1)
        model = build_vla_from_cfg(config["model"])
    with CheckpointWriter(tmp_path, 100, 1) as writer:
        writer.write_bytes("model.safetensors", safetensors.save(model.state_dict()))
        for name, value in files.items():
            writer.write_json(name, value)
        writer.commit()
    return tmp_path
