"""Loss on samples that are not trained on: what it is, what it keeps, and when it ends a run."""

from __future__ import annotations

import os
import random
import signal

import numpy as np
import pytest
import torch

from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.checkpoints.checkpoint import Checkpoint, folders, latest
from fluxvla_core.errors import ConfigError, RunFailed
from fluxvla_core.plugins.registry import VLAS
from fluxvla_core.testing.training import (
    TinyDataset,
    TinyVLA,
    checkpoint_differences,
    differences,
    run_ranks,
    tiny_config,
    train,
    train_all,
    unflushed,
)
from fluxvla_core.training.validation import share_statistics
from fluxvla_core.training.weights import load_for_inference
from tests.training.validated import Held, best_of, losses, make, run, says


@pytest.fixture(autouse=True)
def _fast():
    with unflushed():
        yield


def by_hand(folder):
    """The loss of the checkpoint's acting weights on Held, in batches of 4 that are filled up."""
    model = TinyVLA().eval()
    load_for_inference(model, Checkpoint.open(folder))
    found = []
    for indices in ([0, 1, 2, 3], [4, 5, 6, 0]):
        samples = [Held().get_sample(i, 0) for i in indices]
        batch = {k: torch.stack([torch.as_tensor(s[k]) for s in samples]) for k in samples[0]}
        with torch.no_grad():
            found.append(float(model(**batch)["loss"]))
    return sum(found) / 2


@pytest.mark.parametrize("ema_decay", [None, 0.9])
def test_it_is_the_loss_of_the_weights_that_act(tmp_path, ema_decay):
    """O3 of upstream's bugs: no validation split."""
    run(tmp_path, val_iter_interval=3, save_iter_interval=1, ema_decay=ema_decay)
    found = losses(tmp_path)
    assert list(found) == [3, 6, 8]
    for step, loss in found.items():
        folder = tmp_path / f"checkpoints/step-{step:09d}"
        assert loss == pytest.approx(by_hand(folder), rel=1e-6)


def test_looking_changes_nothing(tmp_path):
    """Not the weights, not what dropout draws, not the averages."""
    run(tmp_path / "looked", val_iter_interval=1, ema_decay=0.9, save_iter_interval=8)
    plain = make(tmp_path / "plain", ema_decay=0.9)
    plain.val_options = None
    plain.run_setup(37)
    plain.run(TinyDataset())
    ends = [folders(tmp_path / d)[-1] for d in ("looked", "plain")]
    assert set(checkpoint_differences(*ends)) == {
        f"{ends[0].name}/{name}" for name in ("config.resolved.json", "trainer.json")
    }


class Stopping(TinyDataset):
    """SIGTERM arrives while the batch of ``step`` is loaded."""

    def __init__(self, step):
        super().__init__()
        self.left = 4 * step

    def get_sample(self, index, epoch):
        self.left -= 1
        if self.left == 0:
            os.kill(os.getpid(), signal.SIGTERM)
        return super().get_sample(index, epoch)


@pytest.mark.parametrize("step", [1, 4, 8])
def test_a_stop_does_not_wait_for_it_and_the_run_that_goes_on_makes_up_for_it(tmp_path, step):
    settings = {
        "val_iter_interval": 1 if step == 1 else 4,
        "learning_rate": 0.3,
        "metric": {"type": "VLAMetric", "window_size": 3},
    }
    run(tmp_path / "whole", **settings)
    cut = make(tmp_path / "cut", **settings)
    cut.run_setup(37)
    with pytest.raises(RunFailed, match=f"step {step} in"):
        cut.run(Stopping(step))
    assert step not in losses(tmp_path / "cut")
    assert (
        latest(tmp_path / "cut").json("trainer.json")["validation"]["owed"]["global_step"] == step
    )
    run(tmp_path / "cut", "auto", **settings)
    assert list(losses(tmp_path / "cut")) == list(losses(tmp_path / "whole"))
    ends = [folders(tmp_path / d)[-1] for d in ("whole", "cut")]
    found = set(differences(tmp_path / "whole", tmp_path / "cut"))
    assert "metrics.jsonl" not in found
    # A run that is stopped at its very end has saved it before.
    late = [f"{ends[0].name}/trainer.json"] if step == 8 else []
    assert checkpoint_differences(*ends) == late
    links = [os.readlink(tmp_path / d / "checkpoints/best") for d in ("whole", "cut")]
    assert links[0] == links[1]
    before = (tmp_path / "cut/metrics.jsonl").read_text().count("\n")
    run(tmp_path / "cut", "auto", **settings)
    assert (tmp_path / "cut/metrics.jsonl").read_text().count("\n") == before == 8


class Faulty(Held):
    """Does ``fault`` at the ``nth`` sample that is read on ``rank``; fits in five batches of 4."""

    def __init__(self, fault=None, nth=0, rank=0):
        super().__init__(20)
        self.fault, self.nth, self.rank, self.read = fault, nth, rank, 0

    def __repr__(self):
        return "Faulty"

    def get_sample(self, index, epoch):
        mine = self.rank == int(os.environ.get("RANK", "0"))
        sample = super().get_sample(index, epoch)
        self.read += mine
        if self.read == self.nth and mine:
            self.fault(sample)
        return sample


def terminate(sample):
    os.kill(os.getpid(), signal.SIGTERM)


def unreadable(sample):
    raise OSError(5, "Input/output error")


def spoil(sample):
    sample["states"][:] = np.nan


def owed(work_dir):
    return latest(work_dir).json("trainer.json")["validation"].get("owed")


@pytest.mark.parametrize("step", [4, 8])
def test_a_stop_ends_it_after_a_batch_and_the_run_that_goes_on_is_the_same(tmp_path, step):
    settings = {"val_iter_interval": 4, "ema_decay": 0.9, "save_iter_interval": 2}
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    run(whole, val={"dataset": Faulty()}, **settings)
    held = Faulty(terminate, (6 if step == 4 else 20 + 6))
    with pytest.raises(RunFailed, match=f"step {step} in"):
        run(cut, val={"dataset": held}, **settings)
    assert held.read == (8 if step == 4 else 20 + 8)
    assert (latest(cut).step, owed(cut)["global_step"]) == (step, step)
    again = Faulty(terminate, 1)
    with pytest.raises(RunFailed, match=f"step {step} in"):
        run(cut, "auto", val={"dataset": again}, **settings)
    assert again.read == 4
    assert (latest(cut).step, owed(cut)["global_step"]) == (step, step)
    run(cut, "auto", val={"dataset": Faulty()}, **settings)
    # The checkpoint of the stop tells that it was one; nothing else differs.
    assert differences(whole, cut) == [f"step-{step:09d}/trainer.json"]
    links = [os.readlink(d / "checkpoints/best") for d in (whole, cut)]
    assert links[0] == links[1]


@pytest.mark.parametrize("kind", ["DDPTrainRunner", "FSDPTrainRunner"])
def test_a_stop_of_one_rank_ends_it_on_all(tmp_path, kind):
    table = {"type": kind, "max_steps": 4, "ema_decay": 0.9, "max_keep_ckpts": 0}
    config = tiny_config({**table, "val_iter_interval": 2, "save_iter_interval": 2}, batch=2)

    def settings(name, dataset, resume=None, **other):
        runner = {**config["runner"], **other}
        held = {**config, "runner": runner, "val_dataloader": {"dataset": dataset}}
        return {"config": held, "work_dir": str(tmp_path / name), "resume": resume}

    assert run_ranks(2, train, settings("cut", Faulty(terminate, 3, rank=1))) == [1, 1]
    assert owed(tmp_path / "cut")["global_step"] == 2
    # Elsewhere the ranks have to agree on what there is to save: with this rate nothing gets
    # better, so that the best is the first one that they know of there.
    rare = {"val_iter_interval": 3, "save_iter_interval": 9, "learning_rate": 9.0, "ema_decay": 0.1}
    first = [str(tmp_path / name / "checkpoints/step-000000002") for name in ("whole", "cut")]
    rest = [
        settings("whole", Faulty()),
        settings("cut", Faulty(), "auto"),
        settings("known", Faulty(), first[0], **rare),
        settings("owed", Faulty(), first[1], **rare),
    ]
    assert run_ranks(2, train_all, *rest, timeout=120.0) == [0, 0]
    assert differences(tmp_path / "whole", tmp_path / "cut") == ["step-000000002/trainer.json"]
    assert os.readlink(tmp_path / "known/checkpoints/best") == "step-000000003"
    assert os.readlink(tmp_path / "owed/checkpoints/best") == "step-000000002"


@pytest.mark.parametrize(
    ("fault", "error"), [(spoil, "the validation loss is nan at step 8"), (unreadable, "Input/out")]
)
def test_one_that_fails_takes_no_checkpoint_with_it(tmp_path, fault, error):
    settings = {"val_iter_interval": 4, "ema_decay": 0.9}
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    run(whole, val={"dataset": Faulty()}, **settings)
    with pytest.raises((RunFailed, OSError), match=error):
        run(cut, val={"dataset": Faulty(fault, 20 + 6)}, **settings)
    assert owed(cut)["global_step"] == 8
    run(cut, "auto", val={"dataset": Faulty()}, **settings)
    assert differences(whole, cut) == ["step-000000008/trainer.json"]
    links = [os.readlink(d / "checkpoints/best") for d in (whole, cut)]
    assert links[0] == links[1]


@pytest.mark.parametrize(("fault", "saved"), [(spoil, 1), (unreadable, 0)])
def test_one_that_fails_on_one_rank_keeps_no_other_waiting(tmp_path, fault, saved):
    """All ranks find a loss that is not finite; of a sample that one cannot read none saves."""
    config = tiny_config({"type": "DDPTrainRunner", "max_steps": 2}, batch=2)
    config["val_dataloader"] = {"dataset": Faulty(fault, 3, rank=1)}
    settings = {"config": config, "work_dir": str(tmp_path)}
    assert run_ranks(2, train, settings, timeout=90.0) == [1, 1]
    assert len(folders(tmp_path)) == saved


@VLAS.register_module()
class NoisyVLA(TinyVLA):
    """Draws noise in its forward pass, in training and in validation."""

    def forward(self, **batch):
        found = super().forward(**batch)
        return {"loss": found["loss"] + torch.randn(()) * 0.1 + random.random() + np.random.rand()}


def test_what_the_model_draws_is_the_same_every_time(tmp_path):
    """Unchanged weights give an unchanged loss, however much the training has drawn by then."""
    settings = {"val_iter_interval": 2, "learning_rate": 1e-12, "model": {"type": "NoisyVLA"}}
    run(tmp_path, **settings)
    found = list(losses(tmp_path).values())
    assert len(found) == 4
    assert max(found) - min(found) < 1e-6


def test_without_an_interval_it_is_measured_with_every_checkpoint(tmp_path):
    run(tmp_path, save_iter_interval=5)
    assert list(losses(tmp_path)) == [5, 8]


def test_one_that_is_made_up_for_in_another_work_dir_is_kept_there(tmp_path, monkeypatch):
    settings = {"val_iter_interval": 4, "learning_rate": 0.3}
    cut = make(tmp_path / "a", **settings)
    cut.run_setup(37)
    with pytest.raises(RunFailed, match="step 4 in"):
        cut.run(Stopping(4))
    place = str(latest(tmp_path / "a").path)
    with pytest.raises(RunFailed, match="step 4 in"):
        run(tmp_path / "b", place, val={"dataset": Faulty(terminate, 1)}, **settings)
    assert owed(tmp_path / "b")["global_step"] == 4
    says(monkeypatch, step_4=1.0, step_8=2.0)
    run(tmp_path / "c", place, **settings)
    assert os.readlink(tmp_path / "c/checkpoints/best") == "step-000000004"
    Checkpoint.open(tmp_path / "c/checkpoints/best").verify()


def test_no_better_loss_for_long_enough_ends_the_run(tmp_path):
    """O3 of upstream's bugs: no early stop."""
    settings = {"val_iter_interval": 1, "learning_rate": 3.0, "early_stop_patience": 2}
    runner = run(tmp_path, max_steps=500, **settings)
    found = losses(tmp_path)
    assert runner.progress.step < 500
    assert list(found)[-3] == best_of(tmp_path) == runner.progress.best_step
    assert latest(tmp_path).step == runner.progress.step
    said = (tmp_path / "said.txt").read_text()
    assert f"(step {runner.progress.best_step}) in 2 validations: training ends" in said
    again = run(tmp_path, "auto", max_steps=500, **settings)
    assert again.progress.step == runner.progress.step


def test_a_loss_that_is_not_finite_is_told(tmp_path):
    with pytest.raises(RunFailed, match="the validation loss is nan at step 3"):
        run(tmp_path, val_iter_interval=3, model={"bad_sample": 104})
    assert folders(tmp_path) == []


def test_workers_and_a_batch_size_of_its_own(tmp_path):
    run(tmp_path / "a", val_iter_interval=4, model={"dropout": 0.0})
    val = {"dataset": Held(), "per_device_batch_size": 7, "per_device_num_workers": 1}
    run(tmp_path / "b", val=val, val_iter_interval=4, model={"dropout": 0.0})
    found = [losses(tmp_path / d) for d in "ab"]
    assert found[0][4] == pytest.approx(found[1][4], rel=0.3)
    assert found[0] != found[1]


@pytest.mark.parametrize(
    ("val", "settings", "message"),
    [
        ({}, {}, "val_dataloader needs a dataset"),
        ({"dataset": Held(), "batch_size": 2}, {}, "val_dataloader.batch_size: unknown key"),
        (
            {"dataset": Held(), "per_device_batch_size": 0},
            {},
            "val_dataloader.per_device_batch_size: must be a whole number above 0, got 0",
        ),
    ],
)
def test_tables_that_cannot_be_meant(tmp_path, val, settings, message):
    with pytest.raises(ConfigError) as caught:
        make(tmp_path, val=val, **settings)
    assert message in str(caught.value)


@pytest.mark.parametrize("key", ["val_iter_interval", "early_stop_patience"])
def test_what_needs_a_validation_set_says_so(tmp_path, key):
    table = {"type": "OneProcessRunner", "max_steps": 1, key: 2}
    config = tiny_config(table)
    with pytest.raises(ConfigError) as caught:
        build_runner_from_cfg(config["runner"], RunContext(config=config, section="runner"))
    assert str(caught.value) == (
        f"{key} needs a val_dataloader, which the config does not have\n"
        "  next: val_dataloader = dict(dataset=dict(type=…, episodes=[…]))"
    )


class Normalised:
    def __init__(self, name="private"):
        self.statistic_name, self.statistics = name, {name: {"action": name}}

    def use_statistics(self, entry):
        self.statistics = {self.statistic_name: entry}


class Mixed:
    def __init__(self, *datasets):
        self.datasets = list(datasets)


def test_it_is_normalised_as_the_training_data_are():
    train_set, val = Normalised(), Normalised()
    train_set.statistics = {"private": {"action": "train's"}}
    share_statistics(train_set, val)
    assert val.statistics == train_set.statistics
    inner = Normalised()
    share_statistics(train_set, Mixed(inner, TinyDataset()))
    assert inner.statistics == train_set.statistics
    message = "statistic_name 'other' is not one of the training data's"
    with pytest.raises(ConfigError, match=message):
        share_statistics(train_set, Normalised("other"))


@pytest.mark.parametrize("kind", ["DDPTrainRunner", "FSDPTrainRunner"])
def test_two_ranks_share_it_and_go_on_as_if_nothing_had_been(tmp_path, kind):
    table = {"type": kind, "max_steps": 4, "ema_decay": 0.9, "max_keep_ckpts": 0}
    looked = tiny_config({**table, "val_iter_interval": 1}, batch=2, dropout=0.0)
    looked["val_dataloader"] = {"dataset": Held()}
    runs = [
        {"config": config, "work_dir": str(tmp_path / name)}
        for name, config in (("looked", looked), ("plain", tiny_config(table, 2, dropout=0.0)))
    ]
    assert run_ranks(2, train_all, *runs) == [0, 0]
    assert list(losses(tmp_path / "looked")) == [1, 2, 3, 4]
    ends = [latest(tmp_path / d).path for d in ("looked", "plain")]
    assert checkpoint_differences(*ends) == [
        f"{ends[0].name}/{name}" for name in ("config.resolved.json", "trainer.json")
    ]
    one = {**looked, "runner": {**looked["runner"], "type": "OneProcessRunner"}}
    one["train_dataloader"] = {"per_device_batch_size": 4}
    train({"config": one, "work_dir": str(tmp_path / "one")})
    alone, shared = losses(tmp_path / "one"), losses(tmp_path / "looked")
    assert shared == pytest.approx(alone, rel=1e-4)
