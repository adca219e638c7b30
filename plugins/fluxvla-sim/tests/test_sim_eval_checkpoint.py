"""Evaluating a checkpoint in worker processes, with a model that a ``--plugin`` file registers."""

from __future__ import annotations

import json

import pytest
from fluxvla_aloha.embodiment import aloha_spec
from fluxvla_sim.eval_runner import AlohaSimEvalRunner

from fluxvla_core.errors import SpecMismatch
from fluxvla_core.operators import Camera, RunContext
from fluxvla_core.plugins.registry import load_plugin_files

safetensors = pytest.importorskip("safetensors.torch")
torch = pytest.importorskip("torch")

MODEL = '''
import torch
from fluxvla_core import VLAS

@VLAS.register_module()
class TremblingVLA(torch.nn.Module):
    """Stays where it is, but for noise; a fresh one also tells its weights apart."""

    action_shape = (5, 14)

    def __init__(self, tremble: float = 1.0) -> None:
        super().__init__()
        self.gain = torch.nn.Parameter(torch.randn(1) * tremble)

    def predict_action(self, images, states, noise):
        seen = images.mean() * 0.01
        return states[:, None, :14] + self.gain * noise * 0.1 + seen
'''


@pytest.fixture
def trembling(tmp_path):
    file = tmp_path / "trembling.py"
    file.write_text(MODEL)
    load_plugin_files([str(file)])


def save(work_dir, camera="top"):
    """A checkpoint as training writes it."""
    from fluxvla_core.checkpoints.writer import CheckpointWriter

    row = {"mean": [0.0] * 14, "std": [1.0] * 14, "min": [-3.0] * 14, "max": [3.0] * 14}
    row |= {"q01": row["min"], "q99": row["max"]}
    transforms = [
        {"type": "ResizeImages", "height": 12, "width": 16},
        {"type": "NormalizeImages", "means": [[127.5] * 3], "stds": [[127.5] * 3]},
        {"type": "NormalizeStatesAndActions", "norm_type": "mean_std"},
    ]
    dataset = {"type": "ParquetDataset", "img_keys": [camera], "transforms": transforms}
    config = {"model": {"type": "TremblingVLA"}, "train_dataloader": {"dataset": dataset}}
    files = {
        "config.resolved.json": {"format": "fluxvla-config-1", "config": config, "origins": {}},
        "dataset_statistics.json": {"private": {"proprio": row, "action": row}},
        "embodiment.json": aloha_spec([Camera(camera, 48, 64)]).to_dict(),
        "policy.json": {"action_rate_hz": 10.0, "horizon": 5},
        "trainer.json": {"left_out": {}},
    }
    with CheckpointWriter(work_dir, 100, 1) as writer:
        weights = safetensors.save({"gain": torch.tensor([1.0])})
        writer.write_bytes("model.safetensors", weights)
        for name, value in files.items():
            writer.write_json(name, value)
        return writer.commit()


def evaluate(work_dir, **arguments):
    runner = AlohaSimEvalRunner(
        context=RunContext(work_dir=work_dir), tasks=("lift_hold",), record_videos=1, **arguments
    )
    runner.run_setup()
    return runner.run()


def hashes(work_dir):
    lines = (work_dir / "eval" / "episodes.jsonl").read_text().splitlines()[1:]
    return sorted((r["group"], r["seed"], r["state_hash"]) for r in map(json.loads, lines))


def test_a_checkpoint_and_its_untrained_twin_are_evaluated(tmp_path, trembling):
    for workers in (1, 2):
        work_dir = tmp_path / str(workers)
        path = save(work_dir)
        results = evaluate(work_dir, episodes=1, baseline=True, workers=workers)
        assert results["checkpoint"]["path"] == str(path)
        assert results["checkpoint"]["step"] == 100
        assert set(results["groups"]) == {"policy", "untrained"}
        assert results["timing"]["policy_ms"] > 0
        assert results["videos"][0]["success"] is False
        images = results["provenance"]["images"]
        assert images["sizes"] == {"top": [48, 64]}
        (by,) = images["by"]
        assert by.partition(":")[0] in {"egl", "osmesa", "glfw", "the platform's own OpenGL"}
        assert by.partition(": ")[2], "the renderer has a name"
    one, two = hashes(tmp_path / "1"), hashes(tmp_path / "2")
    assert one == two
    assert len({state for *_, state in one}) == 2, "the weights matter"


def test_a_checkpoint_for_other_cameras_is_refused_before_it_counts(tmp_path, trembling):
    save(tmp_path, camera="cam_high")
    with pytest.raises(SpecMismatch, match="cameras: cam_high missing"):
        evaluate(tmp_path, episodes=1, workers=1)
    assert not (tmp_path / "eval").exists()
