"""Whole runs of the base class in this process."""

from __future__ import annotations

import json
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import torch

from fluxvla_core.checkpoints.checkpoint import Checkpoint, folders, latest
from fluxvla_core.checkpoints.writer import Disk
from fluxvla_core.errors import CheckpointError, ConfigError, RunFailed
from fluxvla_core.plugins.registry import HOOKS
from fluxvla_core.testing.training import (
    KEYS,
    TinyDataset,
    tiny_config,
    unflushed,
)
from fluxvla_core.training import BaseTrainRunner
from tests.training.runs import Said, make, run


@pytest.fixture(autouse=True)
def _fast():
    with unflushed():
        yield


def test_what_a_dataset_doubts_is_said_before_the_first_step(tmp_path):
    class Doubted(TinyDataset):
        def warnings(self):
            return ["state wrist never moves"]

    said = Said()
    runner = make(tmp_path, reporter=said)
    runner.run_setup(37)
    runner.run(Doubted())
    assert said.lines.count("warning: state wrist never moves") == 1


def test_a_run_ends_with_a_checkpoint_that_is_enough_by_itself(tmp_path):
    """T4 of upstream's bugs: the final state was not saved."""
    said = Said()
    run(tmp_path, reporter=said, ema_decay=0.9)
    found = latest(tmp_path)
    found.verify()
    assert found.step == 6
    assert set(found.manifest.files) == {
        "model.safetensors",
        "ema.safetensors",
        "optimizer.safetensors",
        "optimizer.json",
        "trainer.json",
        "rng/rank-00000.safetensors",
        "config.resolved.json",
        "environment.json",
        "policy.json",
        "embodiment.json",
        "dataset_statistics.json",
    }
    assert found.policy() == {"action_rate_hz": 10.0, "horizon": 2}
    assert found.embodiment() == TinyDataset.embodiment
    assert found.statistics() == TinyDataset.statistics
    assert found.config()["model"] == {"type": "TinyVLA"}
    assert found.json("environment.json")["packages"]["torch"] == version("torch")
    assert not list(tmp_path.rglob("*.pt"))
    assert said.artifacts == [("checkpoint", "step-000000006")]


def test_progress_and_metrics_of_every_step(tmp_path):
    said = Said()
    run(tmp_path, reporter=said, log_iter_interval=4, warmup_ratio=0.5)
    assert [(name, done, total) for name, done, total, _ in said.steps] == [
        ("train", 1, 6),
        ("train", 4, 6),
        ("train", 6, 6),
    ]
    assert set(said.steps[0][3]) == {
        "epoch",
        "loss",
        "grad_norm",
        "lr",
        "step_time",
        "samples_per_s",
        "data_wait",
        "memory_gb",
    }
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [1, 2, 3, 4, 5, 6]
    rates = pytest.approx([0.01 / 3, 0.02 / 3, 0.01, 0.01, 0.01, 0.01])
    assert [row["lr"] for row in rows] == rates
    assert rows[1]["epoch"] == pytest.approx(4 / 37)


def test_training_learns(tmp_path):
    run(tmp_path, max_steps=60, model={"dropout": 0.0, "width": 32}, length=8, batch=8)
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert rows[-1]["loss"] < 0.3 * rows[0]["loss"]


def test_epochs_save_by_epoch_and_at_the_end(tmp_path):
    run(tmp_path, max_epochs=3, save_epoch_interval=2, max_keep_ckpts=0)
    assert [(p.name, Checkpoint.open(p).epoch) for p in folders(tmp_path)] == [
        ("step-000000020", 2),
        ("step-000000030", 3),
    ]


def test_epochs_can_save_by_steps_too_and_only_the_newest_are_kept(tmp_path):
    run(tmp_path, max_epochs=2, save_iter_interval=7, max_keep_ckpts=3)
    assert [p.name for p in folders(tmp_path)] == [
        "step-000000010",
        "step-000000014",
        "step-000000020",
    ]


def test_a_few_episodes_at_a_time(tmp_path):
    """The loop sees them, and a resumed run cannot change how many."""
    seen = []

    class Episodes(TinyDataset):
        episode_ends = np.arange(1, 9) * 4

        def get_sample(self, index, epoch):
            seen.append(index // 4)
            return super().get_sample(index, epoch)

    def train(dataset, together, resume=None):
        runner = make(tmp_path, resume, max_steps=4)
        object.__setattr__(runner.loader_options, "shuffle_episodes", together)
        runner.run_setup(32)
        runner.run(dataset)

    train(Episodes(32), 2)
    assert [len(set(seen[i : i + 8])) for i in (0, 8)] == [2, 2]
    refused = "value of shuffle_episodes is 3, the checkpoint's run had 2"
    with pytest.raises(CheckpointError, match=refused):
        train(Episodes(32), 3, "auto")
    with pytest.raises(ConfigError, match="TinyDataset does not say where its episodes end"):
        train(TinyDataset(32), 2, "auto")


def test_an_optimizer_that_is_not_taken_is_an_error(tmp_path, monkeypatch):
    """T8 of upstream's bugs: training went on with a fresh optimizer."""
    run(tmp_path, max_steps=2)
    runner = make(tmp_path, resume="auto")
    monkeypatch.setattr(type(runner), "_load_optimizer_state", lambda self, state: False)
    runner.run_setup(37)
    with pytest.raises(CheckpointError, match="OneProcessRunner did not take the checkpoint's opt"):
        runner.run(TinyDataset())


def test_a_nan_names_its_sample_and_spoils_no_checkpoint(tmp_path):
    runner = make(tmp_path, model={"bad_sample": 11}, max_epochs=1, save_iter_interval=2)
    runner.run_setup(37)
    with pytest.raises(RunFailed) as caught:
        runner.run(TinyDataset())
    assert "the loss is nan at step" in str(caught.value)
    assert "11" in str(caught.value).splitlines()[1]
    for folder in folders(tmp_path):
        weights = Checkpoint.open(folder).tensors("model.safetensors")
        assert all(torch.isfinite(t).all() for t in weights.values())


def test_a_full_disk_ends_the_run_and_keeps_the_checkpoints_before(tmp_path, monkeypatch):
    write, left = Disk.write, [100]

    def filling(self, file, data):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(28, "No space left on device")
        write(self, file, data)

    monkeypatch.setattr(Disk, "write", filling)
    runner = make(tmp_path, save_iter_interval=1, max_keep_ckpts=0)
    runner.run_setup(37)
    with pytest.raises(RunFailed, match="the disk is full: the checkpoint of step") as caught:
        runner.run(TinyDataset())
    assert caught.value.exit_code == 1
    kept = folders(tmp_path)
    assert kept
    assert [p for p in (tmp_path / "checkpoints").iterdir() if p not in kept] == []
    monkeypatch.undo()
    said = Said()
    run(tmp_path, resume="auto", reporter=said, save_iter_interval=1, max_keep_ckpts=0)
    assert f"resuming from {kept[-1]}" in said.lines[-1]
    assert latest(tmp_path).step == 6


def test_checkpoints_that_cannot_be_removed_are_only_warned_of(tmp_path, monkeypatch):
    def refuse(self, path):
        raise OSError(13, "Permission denied")

    monkeypatch.setattr(Disk, "remove_folder", refuse)
    said = Said()
    run(tmp_path, save_iter_interval=2, max_keep_ckpts=1, reporter=said)
    assert "warning: old checkpoints could not be removed: [Errno 13] Permission" in said.lines[0]
    assert latest(tmp_path).step == 6


def test_accumulation_equals_the_big_batch(tmp_path):
    for name, batch, parts in (("big", 8, 1), ("split", 2, 4)):
        run(
            tmp_path / name,
            batch=batch,
            grad_accumulation_steps=parts,
            model={"dropout": 0.0},
            max_steps=12,
        )
    weights = [latest(tmp_path / d).tensors("model.safetensors") for d in ("big", "split")]
    for name, tensor in weights[0].items():
        if name != "batches":
            assert torch.allclose(tensor, weights[1][name], atol=2e-5), name
    rows = [
        [json.loads(line)["loss"] for line in (tmp_path / d / "metrics.jsonl").open()]
        for d in ("big", "split")
    ]
    assert rows[0] == pytest.approx(rows[1], rel=1e-4)


def test_bf16_computes_over_fp32_weights(tmp_path):
    """T6 of upstream's bugs: weights themselves were bf16."""
    plain = run(tmp_path / "a", max_steps=2)
    mixed = run(tmp_path / "b", max_steps=2, enable_mixed_precision_training=True)
    weights = latest(tmp_path / "b").tensors("model.safetensors")
    assert {t.dtype for n, t in weights.items() if n != "batches"} == {torch.float32}
    assert plain.progress.loss != mixed.progress.loss
    assert plain.progress.loss == pytest.approx(mixed.progress.loss, rel=0.05)


def test_recomputing_activations_changes_nothing(tmp_path):
    run(tmp_path / "a")
    run(tmp_path / "b", enable_gradient_checkpointing=True)
    pair = [latest(tmp_path / d).manifest.files["optimizer.safetensors"] for d in "ab"]
    assert pair[0] == pair[1]


def test_no_clipping(tmp_path):
    run(tmp_path, max_grad_norm=None)
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").open()]
    assert all(row["grad_norm"] > 0 for row in rows)


def test_two_workers_change_nothing(tmp_path):
    run(tmp_path / "a")
    runner = make(tmp_path / "b")
    object.__setattr__(runner.loader_options, "per_device_num_workers", 2)
    runner.run_setup(37)
    runner.run(TinyDataset())
    pair = [latest(tmp_path / d).manifest.files["model.safetensors"] for d in "ab"]
    assert pair[0] == pair[1]


def test_the_seed_makes_the_run(tmp_path):
    """T7 of upstream's bugs: training was never seeded."""
    found = []
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        run(tmp_path / name, seed=seed)
        found.append(latest(tmp_path / name).manifest.files["model.safetensors"].sha256)
    assert found[0] == found[1] != found[2]


@HOOKS.register_module()
class TrainLog:
    calls: list = []  # noqa: RUF012 - read by the test

    def run_started(self):
        self.calls.append("started")

    def before_step(self, step):
        self.calls.append(f"before {step}")

    def after_step(self, step, metrics):
        self.calls.append(f"after {step} {sorted(metrics)[2]}")

    def checkpoint_saved(self, path, step):
        self.calls.append(f"saved {path.name} {step}")

    def run_finished(self, outcome):
        self.calls.append(outcome)


def test_hooks_of_a_run(tmp_path):
    run(tmp_path, max_steps=2, hooks=["TrainLog"])
    assert TrainLog.calls == [
        "started",
        "before 1",
        "after 1 grad_norm",
        "before 2",
        "after 2 grad_norm",
        "saved step-000000002 2",
        "ok",
    ]


def test_a_batch_key_that_the_model_does_not_take_is_refused_at_the_first_step(tmp_path):
    class Extra(TinyDataset):
        def get_sample(self, index, epoch):
            sample = super().get_sample(index, epoch)
            return {**sample, "action_mask": sample["noise"]}

    collator = {"type": "DictCollator", "keys": [*KEYS, "action_mask"]}
    runner = make(tmp_path, collator=collator)
    runner.run_setup(37)
    with pytest.raises(ConfigError, match=r"TinyVLA\.forward takes no 'action_mask'"):
        runner.run(Extra())


def test_errors_before_the_first_step_are_what_they_are(tmp_path):
    class Broken(TinyDataset):
        def prepare(self, reporter):
            raise RuntimeError("the socket of the decoder")

    runner = make(tmp_path)
    runner.run_setup(37)
    with pytest.raises(RuntimeError, match="the socket of the decoder"):
        runner.run(Broken())


def test_processors_are_saved_with_the_checkpoint(tmp_path):
    class Tokenizer:
        def save_pretrained(self, folder):
            folder.mkdir(parents=True, exist_ok=True)
            (folder / "vocab.txt").write_text("a")

    class WithPipeline(TinyDataset):
        pipeline = Tokenizer()

    run(tmp_path / "own", tokenizer=Tokenizer(), max_steps=1)
    assert "processors/tokenizer/vocab.txt" in latest(tmp_path / "own").manifest.files
    runner = make(tmp_path / "data", max_steps=1)
    runner.run_setup(37)
    runner.run(WithPipeline())
    assert "processors/vocab.txt" in latest(tmp_path / "data").manifest.files


def test_several_processes_need_a_strategy(tmp_path):
    runner = make(tmp_path)
    runner._join()
    runner._world = type(runner.world)(0, 2, 0, torch.device("cpu"))
    with pytest.raises(ConfigError) as caught:
        runner._wrap_model(torch.nn.Linear(1, 1))
    assert str(caught.value) == (
        "OneProcessRunner trains on one process, and there are 2\n"
        "  next: use DDPTrainRunner or FSDPTrainRunner, or override _wrap_model"
    )


def test_without_a_context_a_config_is_enough(tmp_path, monkeypatch):
    """The specification constructs runners with keywords only."""
    from fluxvla_core import BaseTrainRunner

    monkeypatch.chdir(tmp_path)
    config = tiny_config({})
    runner = BaseTrainRunner(cfg=config, max_steps=2, **config["runner"])
    runner.run_setup(37)
    assert runner.run(TinyDataset()) == Path("work_dirs/run")
    assert latest(tmp_path / "work_dirs/run").step == 2


def test_what_only_exists_inside_a_run_says_so(tmp_path):
    runner = make(tmp_path)
    with pytest.raises(RuntimeError, match="the world is known from run_setup on"):
        _ = runner.world
    with pytest.raises(RuntimeError, match=r"there is a trainer only inside run\(\)"):
        _ = runner.trainer
    runner.run_setup(37)
    with pytest.raises(RuntimeError, match=r"a batch's arguments are known inside run\(\) only"):
        runner._training_step({})


def test_a_strategy_that_overrides_the_deprecated_hook_is_called():
    class Old(BaseTrainRunner):
        def warm_up(self, batch):
            batches.append(batch)

    batches = []
    with pytest.warns(DeprecationWarning, match="Old.warm_up is deprecated, call it before_first"):
        object.__new__(Old).before_first_step({"images": 1})
    assert batches == [{"images": 1}]
