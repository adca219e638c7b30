"""An exported checkpoint acts as the checkpoint did, without what trained it."""

from __future__ import annotations

import hashlib
import json

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save

from fluxvla_core.checkpoints.checkpoint import Checkpoint
from fluxvla_core.checkpoints.manifest import FileEntry, Manifest, read_manifest
from fluxvla_core.checkpoints.writer import CheckpointWriter, Disk
from fluxvla_core.cli.main import main
from fluxvla_core.errors import CheckpointError, FluxError, RunFailed, UsageError
from fluxvla_core.plugins.registry import VLAS
from fluxvla_core.policies.loading import load_policy
from fluxvla_core.spec import Camera, EmbodimentSpec, Joint
from fluxvla_core.training.export import export
from fluxvla_core.training.weights import external_weights

ARM = EmbodimentSpec(
    "arm",
    tuple(Joint(n, "rad", -1.0, 1.0, 1.0, 1.0) for n in "ab"),
    (Camera("front", 8, 8),),
    50.0,
)
ROW = {"mean": [0.1, 0.2], "std": [0.5, 2.0]}


class ActsVLA(torch.nn.Module):
    """A trained gain, a frozen part from a package, and a weight under two names."""

    action_shape = (4, 2)

    def __init__(self):
        super().__init__()
        self.gain = torch.nn.Linear(2, 2)
        self.frozen = torch.nn.Linear(2, 2).requires_grad_(False)
        self.tied = self.gain
        with torch.no_grad():
            self.frozen.weight.fill_(3.0)
            self.frozen.bias.fill_(1.0)
        self.frozen.frozen_source = "a package"

    def predict_action(self, images, states, noise):
        return self.frozen(self.gain(noise)) + states[:, None]


@pytest.fixture(autouse=True)
def model():
    VLAS.register_module()(ActsVLA)
    yield
    VLAS.unregister("ActsVLA")


def saved(work_dir, ema=True):
    dataset = {
        "type": "ParquetDataset",
        "data_root_path": "gone",
        "img_keys": ["observation.images.front"],
        "transforms": [{"type": "NormalizeStatesAndActions", "norm_type": "mean_std"}],
    }
    config = {
        "model": {"type": "ActsVLA"},
        "train_dataloader": {"dataset": dataset},
        "runner": {"type": "NobodyHasThisTrainRunner"},
    }
    origins = {"model.type": "c.py:1", "runner.type": "c.py:2"}
    weights = {"gain.weight": torch.eye(2) * 2, "gain.bias": torch.tensor([0.5, -0.5])}
    tied = {f"tied.{n.partition('.')[2]}": t.clone() for n, t in weights.items()}
    external = external_weights(ActsVLA()).to_dict()
    with CheckpointWriter(work_dir, 7, 1) as writer:
        writer.write_bytes("model.safetensors", save({**weights, **tied}))
        if ema:
            averaged = {n: t + 0.25 for n, t in weights.items()}
            averaged |= {f"tied.{n.partition('.')[2]}": t.clone() for n, t in averaged.items()}
            writer.write_bytes("ema.safetensors", save(averaged))
        writer.write_bytes("optimizer.safetensors", b"state")
        writer.write_json("optimizer.json", {})
        writer.write_bytes("rng/rank-00000.safetensors", b"r")
        writer.write_json(
            "config.resolved.json",
            {"format": "fluxvla-config-1", "config": config, "origins": origins},
        )
        writer.write_json("dataset_statistics.json", {"private": {"proprio": ROW, "action": ROW}})
        writer.write_json("embodiment.json", ARM.to_dict())
        writer.write_json("environment.json", {"torch": "2"})
        writer.write_json("policy.json", {"action_rate_hz": 10.0, "horizon": 4})
        writer.write_json("trainer.json", {"left_out": external})
        writer.write_bytes("processors/tokenizer/t.json", b"{}")
        return writer.commit()


def actions(place):
    policy = load_policy(place)
    policy.reset(3)
    observation = {
        "qpos": np.array([0.3, -0.4], np.float32),
        "images": {"front": np.zeros((8, 8, 3), np.uint8)},
        "task_description": "wave",
    }
    return np.stack([policy.predict_action(observation) for _ in range(2)])


@pytest.mark.parametrize("ema", [True, False])
def test_an_export_acts_as_the_checkpoint_does(tmp_path, capsys, ema):
    source = saved(tmp_path / "run", ema)
    target = tmp_path / "out" / "policy"
    assert main(["export", str(source), str(target)]) == 0
    assert capsys.readouterr().out == (
        f"{target}: model.safetensors of 0.0 MB and what it needs to act\n"
    )
    np.testing.assert_array_equal(actions(source), actions(target))
    files = {p.relative_to(target).as_posix() for p in target.rglob("*") if p.is_file()}
    assert files == {
        "manifest.json",
        "model.safetensors",
        "trainer.json",
        "config.resolved.json",
        "dataset_statistics.json",
        "embodiment.json",
        "environment.json",
        "policy.json",
        "processors/tokenizer/t.json",
    }
    Checkpoint.open(target).verify()
    assert [p.name for p in target.parent.iterdir()] == ["policy"]


def test_all_weights_are_in_one_plain_file(tmp_path):
    target = export(saved(tmp_path / "run"), tmp_path / "out")
    found = load_file(target / "model.safetensors")
    assert set(found) == {"gain.weight", "gain.bias", "frozen.weight", "frozen.bias"}
    assert torch.equal(found["gain.weight"], torch.eye(2) * 2 + 0.25)
    # The frozen part may change with its package: the export keeps what it was.
    assert Checkpoint.open(target).json("trainer.json")["left_out"]["sha256"] == ""


def test_what_only_training_needs_is_left_out_of_the_config(tmp_path):
    export(saved(tmp_path / "run"), tmp_path / "out")
    text = (tmp_path / "out" / "config.resolved.json").read_text()
    assert "NobodyHasThisTrainRunner" not in text
    assert json.loads(text)["origins"] == {"model.type": "c.py:1"}


def test_a_folder_with_something_in_it_is_left_alone(tmp_path):
    source = saved(tmp_path / "run")
    (tmp_path / "out").mkdir()
    export(source, tmp_path / "out")
    with pytest.raises(UsageError, match=f"there is something at {tmp_path}/out already"):
        export(source, tmp_path / "out")


def test_a_place_that_cannot_be_written_in(tmp_path):
    source = saved(tmp_path / "run")
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match="cannot write to the folder to export to"):
        export(source, tmp_path / "file" / "policy")


def test_a_damaged_checkpoint_is_not_exported(tmp_path):
    source = saved(tmp_path / "run")
    (source / "policy.json").write_text("{}")
    with pytest.raises(CheckpointError, match=r"policy\.json is damaged"):
        export(source, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_full_disk_leaves_nothing_behind(tmp_path, monkeypatch):
    def full(self, file, data):
        raise OSError(28, "No space left on device")

    source = saved(tmp_path / "run")
    monkeypatch.setattr(Disk, "write", full)
    with pytest.raises(RunFailed, match="the disk is full"):
        export(source, tmp_path / "out" / "policy")
    assert list((tmp_path / "out").iterdir()) == []


def test_a_full_disk_says_how_an_export_goes_on(tmp_path, monkeypatch):
    def full(self, file, data):
        raise OSError(28, "No space left on device")

    source = saved(tmp_path / "run")
    monkeypatch.setattr(Disk, "write", full)
    with pytest.raises(RunFailed) as caught:
        export(source, tmp_path / "out")
    assert caught.value.what == "the disk is full: the export could not be saved"
    assert "export again, or name a folder on another disk" in str(caught.value)
    assert "--resume" not in str(caught.value)


def test_only_files_that_the_manifest_vouches_for_are_copied(tmp_path, monkeypatch):
    source = saved(tmp_path / "run")
    (source / "processors").mkdir(exist_ok=True)
    (source / "processors" / "planted.json").write_text("{}")
    out = export(source, tmp_path / "out")
    assert not (out / "processors" / "planted.json").exists()
    Checkpoint.open(out).verify()

    def swapped(self):  # another process writes between the check and the copy
        (source / "policy.json").write_text('{"horizon": 3}')

    monkeypatch.setattr(Checkpoint, "verify", swapped)
    with pytest.raises(CheckpointError, match=r"policy\.json was changed since it was saved"):
        export(source, tmp_path / "again")
    assert not (tmp_path / "again").exists()


@pytest.mark.parametrize(
    ("name", "text", "fact"),
    [
        ("trainer.json", '{"left_out": 3}', "trainer.json: left_out"),
        ("trainer.json", '{"left_out": {"sha256": 1}}', "trainer.json: left_out.sha256"),
        ("config.resolved.json", '{"config": []}', "config.resolved.json: config"),
        ("policy.json", '{"action_rate_hz": Infinity, "horizon": 1}', "policy.json: action_rate"),
        ("policy.json", '{"action_rate_hz": -1, "horizon": 1}', "policy.json: action_rate_hz"),
        ("policy.json", '{"action_rate_hz": 5, "horizon": "4"}', "policy.json: horizon"),
        ("dataset_statistics.json", '{"private": 1}', "dataset_statistics.json: private"),
        ("embodiment.json", '{"joints": 1}', "not an embodiment spec"),
    ],
)
def test_wrong_types_in_a_checkpoint_are_named(tmp_path, name, text, fact):
    source = saved(tmp_path / "run")
    (source / name).write_text(text)
    found = read_manifest(source)
    entry = FileEntry(len(text), hashlib.sha256(text.encode()).hexdigest())
    manifest = Manifest(found.step, found.epoch, {**found.files, name: entry})
    (source / "manifest.json").write_bytes(manifest.to_bytes())
    with pytest.raises(FluxError) as caught:
        load_policy(source)
    assert fact in str(caught.value)
    assert caught.value.exit_code == 2
