"""``checkpoints/best``: which one it names, and that it is kept."""

from __future__ import annotations

import os

import pytest

from fluxvla_core.checkpoints.checkpoint import Checkpoint, folders, latest
from fluxvla_core.testing.training import TinyDataset, differences, unflushed
from tests.training.validated import best_of, losses, make, run, says


@pytest.fixture(autouse=True)
def _fast():
    with unflushed():
        yield


def test_the_best_one_is_saved_named_and_kept(tmp_path):
    """With a rate this high the loss goes up and down."""
    settings = {"val_iter_interval": 1, "max_keep_ckpts": 1, "learning_rate": 0.3, "max_steps": 12}
    run(tmp_path, **settings)
    best = best_of(tmp_path)
    assert 1 <= best < 12
    assert [p.name for p in folders(tmp_path)] == [f"step-{best:09d}", "step-000000012"]
    assert os.readlink(tmp_path / "checkpoints" / "best") == f"step-{best:09d}"
    assert Checkpoint.open(tmp_path / "checkpoints" / "best").step == best
    assert latest(tmp_path).step == 12
    said = latest(tmp_path).json("trainer.json")["validation"]
    assert said == {
        "best": losses(tmp_path)[best],
        "best_step": best,
        "worse": 12 - best,
    }


def test_a_run_that_goes_on_knows_the_best_one(tmp_path):
    settings = {
        "val_iter_interval": 1,
        "learning_rate": 0.3,
        "save_iter_interval": 6,
        "max_keep_ckpts": 2,
    }
    run(tmp_path / "whole", max_steps=12, **settings)
    run(tmp_path / "cut", max_steps=6, **settings)
    (tmp_path / "cut/checkpoints/best").unlink()
    run(tmp_path / "cut", "auto", max_steps=12, **settings)
    found = set(differences(tmp_path / "whole", tmp_path / "cut"))
    assert {name.partition("/")[2] for name in found} <= {"config.resolved.json"}
    links = [os.readlink(tmp_path / d / "checkpoints/best") for d in ("whole", "cut")]
    assert links[0] == links[1]


def test_a_best_one_that_was_lost_is_no_longer_the_one_to_beat(tmp_path, monkeypatch):
    """Removed in favour of step 6, which is damaged: neither that name nor that loss counts."""
    settings = {"val_iter_interval": 2, "save_iter_interval": 2, "max_keep_ckpts": 2}
    says(monkeypatch, step_2=1.0, step_4=2.0, step_6=0.5)
    run(tmp_path, max_steps=6, **settings)
    damaged = folders(tmp_path)[-1] / "model.safetensors"
    damaged.write_bytes(damaged.read_bytes()[:-1])
    says(monkeypatch, step_6=8.0, step_8=9.0, step_10=9.5)
    again = run(tmp_path, "auto", max_steps=10, **settings)
    assert os.readlink(tmp_path / "checkpoints/best") == "step-000000006"
    assert (again.progress.best_step, again.progress.best) == (6, 8.0)
    assert [p.name for p in folders(tmp_path)] == [f"step-{n:09d}" for n in (6, 8, 10)]


def test_no_best_one_is_named_before_there_is_one(tmp_path, monkeypatch):
    """Of the run that was left behind the link would be, and then name this run's step 4."""
    says(monkeypatch, step_4=1.0)
    run(tmp_path, max_steps=4, save_iter_interval=2, val_iter_interval=4)
    earlier = str(folders(tmp_path)[0])
    again = run(tmp_path, earlier, max_steps=4, val_iter_interval=4)
    assert os.readlink(tmp_path / "checkpoints/best") == "step-000000004"
    assert latest(tmp_path).path.resolve() == (tmp_path / "checkpoints/best").resolve()
    plain = make(tmp_path, earlier, max_steps=4)
    plain.val_options = None
    plain.run_setup(37)
    plain.run(TinyDataset())
    assert not (tmp_path / "checkpoints/best").is_symlink()
    assert again.progress.best_step == 4


def test_what_was_set_aside_does_not_know_the_ones_that_took_its_place(tmp_path, monkeypatch):
    settings = {"val_iter_interval": 2, "save_iter_interval": 2}
    says(monkeypatch, step_2=1.0, step_4=0.5, step_6=2.0, step_8=3.0)
    run(tmp_path, max_steps=6, **settings)
    run(tmp_path, str(folders(tmp_path)[0]), max_steps=6, **settings)
    aside = tmp_path / "checkpoints/step-000000006.set-aside"
    run(tmp_path, str(aside), max_steps=8, **settings)
    assert os.readlink(tmp_path / "checkpoints/best") == "step-000000008"


def test_in_another_work_dir_the_best_one_is_one_of_its_own(tmp_path, monkeypatch):
    settings = {"val_iter_interval": 2, "save_iter_interval": 2}
    says(monkeypatch, step_2=1.0, step_4=2.0)
    run(tmp_path / "a", max_steps=4, **settings)
    says(monkeypatch, step_6=3.0, step_8=4.0)
    again = run(tmp_path / "b", str(latest(tmp_path / "a").path), max_steps=8, **settings)
    assert os.readlink(tmp_path / "b/checkpoints/best") == "step-000000006"
    assert again.progress.best_step == 6
