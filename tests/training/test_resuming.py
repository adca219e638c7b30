"""A run goes on from a checkpoint, or says why it does not."""

from __future__ import annotations

import json
import os
import shutil
import signal
from typing import ClassVar

import numpy as np
import pytest

from fluxvla_core.checkpoints import lock
from fluxvla_core.checkpoints.checkpoint import folders, latest
from fluxvla_core.errors import CheckpointError, RunFailed, UsageError
from fluxvla_core.testing.training import (
    TinyDataset,
    checkpoint_differences,
    differences,
    run_ranks,
    unflushed,
)
from tests.training.runs import Said, make, run


@pytest.fixture(autouse=True)
def _fast():
    with unflushed():
        yield


def test_a_fresh_run_refuses_anothers_work_dir(tmp_path):
    run(tmp_path)
    with pytest.raises(UsageError) as caught:
        make(tmp_path).run_setup(37)
    assert str(caught.value) == (
        f"{tmp_path}: the work dir already holds checkpoints, up to step 6\n"
        "  next: resume from there: --resume auto; or use another folder: --work-dir DIR"
    )
    run(tmp_path / "other")
    with pytest.raises(UsageError, match="already holds checkpoints"):
        make(tmp_path, resume=str(tmp_path / "other/checkpoints/step-000000006")).run_setup(37)


def test_auto_starts_afresh_and_says_so(tmp_path):
    said = Said()
    run(tmp_path, resume="auto", reporter=said)
    assert said.lines == [f"no checkpoint in {tmp_path} yet: training starts from scratch"]


def test_a_path_must_exist(tmp_path):
    with pytest.raises(CheckpointError, match="there is no checkpoint at"):
        make(tmp_path, resume=str(tmp_path / "checkpoints/step-000000003")).run_setup(37)


def test_a_finished_run_has_nothing_left_to_do(tmp_path):
    run(tmp_path)
    before = latest(tmp_path).manifest
    run(tmp_path, resume="auto")
    assert latest(tmp_path).manifest == before
    assert len(folders(tmp_path)) == 1


def test_more_steps_go_on_from_the_end_as_if_they_had_been_asked_for(tmp_path):
    run(tmp_path / "whole", max_steps=9, save_iter_interval=6)
    run(tmp_path / "twice", save_iter_interval=6)
    run(tmp_path / "twice", resume="auto", max_steps=9, save_iter_interval=6)
    # The configs differ in max_steps, and nothing else does.
    assert differences(tmp_path / "whole", tmp_path / "twice") == [
        "step-000000006/config.resolved.json"
    ]


def test_resume_from_in_the_config_and_the_command_line_before_it(tmp_path):
    run(tmp_path, save_iter_interval=2, max_keep_ckpts=0)
    said = Said()
    here = f"{tmp_path}/checkpoints/step-00000000"
    make(tmp_path, reporter=said, resume_from=f"{here}4").run_setup(37)
    assert said.lines == [
        "warning: a later checkpoint is set aside as step-000000006.set-aside",
        f"resuming from {here}4 (step 4)",
    ]
    said = Said()
    make(tmp_path, f"{here}2", reporter=said, resume_from=f"{here}4").run_setup(37)
    assert said.lines[-1] == f"resuming from {here}2 (step 2)"


def test_auto_goes_on_from_the_configs_checkpoint_until_the_work_dir_has_one(tmp_path):
    run(tmp_path / "first", max_steps=2)
    place = str(tmp_path / "first/checkpoints/step-000000002")
    for steps, found in ((3, place), (4, f"{tmp_path}/next/checkpoints/step-000000003")):
        said = Said()
        run(tmp_path / "next", "auto", reporter=said, resume_from=place, max_steps=steps)
        assert said.lines[0] == f"resuming from {found} (step {steps - 1})"


def test_a_damaged_newest_one_is_named_and_passed_over_by_auto_and_refused_by_path(tmp_path):
    run(tmp_path / "whole", save_iter_interval=2, max_keep_ckpts=0)
    run(tmp_path / "hurt", save_iter_interval=2, max_keep_ckpts=0)
    newest = folders(tmp_path / "hurt")[-1]
    data = bytearray((newest / "model.safetensors").read_bytes())
    data[-1] ^= 1
    (newest / "model.safetensors").write_bytes(data)
    with pytest.raises(CheckpointError) as caught:
        make(tmp_path / "hurt", resume=str(newest)).run_setup(37)
    assert "model.safetensors is damaged" in str(caught.value)
    assert f"the one before it is undamaged: {folders(tmp_path / 'hurt')[-2]}" in str(caught.value)
    said = Said()
    run(tmp_path / "hurt", resume="auto", reporter=said, save_iter_interval=2, max_keep_ckpts=0)
    assert said.lines[0].startswith(
        f"warning: not resuming from a damaged checkpoint: {newest}: model.safetensors is damaged"
    )
    assert differences(tmp_path / "whole", tmp_path / "hurt") == []


def test_when_all_are_damaged_nothing_starts_afresh(tmp_path):
    run(tmp_path)
    (folders(tmp_path)[0] / "policy.json").write_text("{}")
    with pytest.raises(CheckpointError, match=r"policy\.json is damaged"):
        make(tmp_path, resume="auto").run_setup(37)


def resume_error(tmp_path, length=37, **settings):
    run(tmp_path, max_steps=2)
    with pytest.raises(CheckpointError) as caught:
        run(tmp_path, resume="auto", length=length, **settings)
    assert caught.value.exit_code == 2
    return str(caught.value)


def test_another_models_checkpoint_is_refused(tmp_path):
    """T3, T8 of upstream's bugs: wrong weights and optimizer states resumed with a warning."""
    message = resume_error(tmp_path, model={"width": 16})
    assert "the weights of the checkpoint are not this model's" in message
    assert "of another size: blocks.0.linear.bias: (8,) in the checkpoint, (16,) here" in message


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"seed": 7}, "the seed is 7, the checkpoint's run had 42"),
        ({"length": 38}, "the number of samples in the dataset is 38, the checkpoint's run had 37"),
        ({"ema_decay": 0.9}, "ema_decay is set, and the checkpoint's run kept no averaged"),
    ],
)
def test_another_runs_checkpoint_is_refused(tmp_path, settings, message):
    assert message in resume_error(tmp_path, **settings)


class Drawing(TinyDataset):
    """Draws by a seed of its own, or by the run's."""

    def __init__(self, seed=None):
        super().__init__()
        self.given = self.seed = seed

    def use_seed(self, seed):
        self.seed = seed if self.given is None else self.given


def draw(work_dir, own, resume=None, **settings):
    runner = make(work_dir, resume, **settings)
    runner.run_setup(37)
    dataset = Drawing(own)
    runner.run(dataset)
    return dataset.seed


def test_a_dataset_draws_by_the_runs_seed_and_resumes_by_the_same(tmp_path):
    assert draw(tmp_path, None, max_steps=2, seed=7) == 7
    assert draw(tmp_path, None, "auto", max_steps=4, seed=7) == 7
    assert draw(tmp_path, 7, "auto", max_steps=6, seed=7) == 7
    with pytest.raises(CheckpointError) as caught:
        draw(tmp_path, 3, "auto", max_steps=8, seed=7)
    assert "the seed of the dataset is 3, the checkpoint's run had 7" in str(caught.value)


def test_averages_are_not_dropped_without_a_word(tmp_path):
    run(tmp_path, max_steps=2, ema_decay=0.9)
    with pytest.raises(CheckpointError) as caught:
        run(tmp_path, resume="auto")
    assert str(caught.value) == (
        f"{tmp_path}/checkpoints/step-000000002: ema_decay is not set, and the checkpoint's run "
        "kept averaged weights, which are used for inference\n"
        "  next: set it back: the checkpoint's config.resolved.json has its value; or begin "
        "another run from these weights: --set '<section>.init_from="
        f"{tmp_path}/checkpoints/step-000000002' --work-dir OTHER"
    )


class Rescaled(TinyDataset):
    statistics: ClassVar = {"private": {"action": {"mean": [0.0] * 3, "std": [1.0, 1.0, 2.0]}}}


def test_data_that_are_normalised_otherwise_are_refused(tmp_path):
    run(tmp_path, max_steps=2)
    runner = make(tmp_path, resume="auto")
    runner.run_setup(37)
    with pytest.raises(CheckpointError) as caught:
        runner.run(Rescaled())
    assert (
        "the dataset's statistics are not those of the checkpoint's run: private.action.std\n"
        in str(caught.value)
    )


def test_changed_settings_are_listed_once_and_what_changes_nothing_is_not(tmp_path):
    run(tmp_path, max_steps=2, weight_decay=0.1)
    said = Said()
    run(
        tmp_path,
        resume="auto",
        reporter=said,
        learning_rate=2e-2,
        optimizer={"type": "AdamW", "betas": [0.9, 0.95]},
        model={"dropout": 0.3},
        max_keep_ckpts=5,
        log_iter_interval=3,
    )
    assert said.lines[1:] == [
        "warning: other settings than those of the checkpoint's run:\n"
        "    runner.learning_rate: 0.01 -> 0.02\n"
        "    runner.weight_decay: 0.1 -> not set\n"
        '    runner.optimizer.type: not set -> "AdamW"\n'
        "    runner.optimizer.betas: not set -> [0.9, 0.95]\n"
        "    model.dropout: not set -> 0.3"
    ]


def test_another_batch_size_goes_on_at_the_same_sample_and_says_so(tmp_path):
    said = Said()
    run(tmp_path, max_steps=2)
    runner = run(tmp_path, resume="auto", reporter=said, batch=8, max_steps=3)
    assert said.lines[-1] == (
        "warning: steps use 8 samples now and 4 in the checkpoint's run: the order of samples "
        "stays, the result will differ"
    )
    assert runner.progress.cursor.samples == 2 * 4 + 8


@pytest.mark.parametrize(("before", "after"), [(4, 8), (8, 4)])
def test_the_rate_follows_the_part_of_the_epochs_that_is_done(tmp_path, before, after):
    """Counted in the old steps, larger ones were past the schedule's end: a rate of 0."""
    schedule = {"lr_scheduler_type": "linear-warmup+cosine-decay", "max_epochs": 4}
    schedule["log_iter_interval"] = 1
    run(tmp_path, batch=before, **{**schedule, "max_epochs": 3})
    runner = run(tmp_path, resume="auto", batch=after, **schedule)
    rows = map(json.loads, (tmp_path / "metrics.jsonl").read_text().splitlines())
    rates = {row["step"]: row["lr"] for row in rows}
    first = -(-37 // before) * 3
    steps = -(-37 // after)
    assert list(rates)[first:] == list(range(first + 1, first + steps + 1))
    peak = runner.options.learning_rate
    done = (3 * steps + np.arange(steps)) / (4 * steps)
    expected = 0.5 * peak * (1 + np.cos(np.pi * done))
    np.testing.assert_allclose(list(rates.values())[first:], expected, rtol=1e-6)
    assert runner.total_steps == first + steps


def other_run(work_dir, left):
    """In another process: what becomes of what ``left`` is while this one trains, and after."""
    lock.PATIENCE_S = 0.0
    try:
        make(work_dir, "auto").run_setup(37)
    except UsageError as error:
        (work_dir / "refused.txt").write_text(error.what)
        assert left.is_dir()
    else:
        assert not left.is_dir()


def test_the_same_command_started_twice_leaves_the_firsts_checkpoints_alone(tmp_path):
    left = tmp_path / "checkpoints/step-000000099.partial"
    runner = make(tmp_path)
    runner.run_setup(37)
    left.mkdir()
    assert run_ranks(1, other_run, tmp_path, left) == [0]
    assert (
        f"in use by another training: process {os.getpid()}"
        in (tmp_path / "refused.txt").read_text()
    )
    runner.run(TinyDataset())
    assert run_ranks(1, other_run, tmp_path, left) == [0]
    assert not left.is_dir()


@pytest.mark.parametrize("saving", [{"save_iter_interval": 1}, {"async_save": False}, {}])
def test_a_work_dir_that_is_removed_ends_the_run_and_is_not_made_again(
    tmp_path, saving, monkeypatch
):
    class Removing(TinyDataset):
        def get_sample(self, index, epoch):
            self.asked = getattr(self, "asked", 0) + 1
            if self.asked == 4 * 5:
                (tmp_path / "work").rename(tmp_path / "away")
                shutil.rmtree(tmp_path / "away", ignore_errors=True)
            return super().get_sample(index, epoch)

    runner = make(tmp_path / "work", **{"save_iter_interval": 2, "max_steps": 9, **saving})
    runner.run_setup(37)
    with pytest.raises(RunFailed) as caught:
        runner.run(Removing())
    assert str(caught.value).startswith(f"the work dir {tmp_path}/work was taken away from this")
    assert not (tmp_path / "work").exists()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_saves_and_the_run_goes_on_exactly(tmp_path, number):
    """O3 of upstream's bugs: no SIGTERM handling."""

    class Interrupting(TinyDataset):
        def get_sample(self, index, epoch):
            self.asked = getattr(self, "asked", 0) + 1
            if self.asked == 4 * 3:
                os.kill(os.getpid(), number)
            return super().get_sample(index, epoch)

    run(tmp_path / "whole", max_keep_ckpts=0)
    runner = make(tmp_path / "cut", max_keep_ckpts=0)
    runner.run_setup(37)
    with pytest.raises(KeyboardInterrupt if number == signal.SIGINT else RunFailed) as caught:
        runner.run(Interrupting())
    assert f"step 3 in {tmp_path}/cut" in str(caught.value)
    assert [p.name for p in folders(tmp_path / "cut")] == ["step-000000003"]
    run(tmp_path / "cut", resume="auto", max_keep_ckpts=0)
    assert [p.name for p in folders(tmp_path / "cut")] == ["step-000000003", "step-000000006"]
    ends = [folders(tmp_path / name)[-1] for name in ("whole", "cut")]
    assert checkpoint_differences(*ends) == []
    assert "metrics.jsonl" not in differences(tmp_path / "whole", tmp_path / "cut")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_while_a_run_closes_changes_nothing(tmp_path, number):
    """All is saved by then: the run ended well, and says that it was asked to stop."""
    runner = make(tmp_path)
    runner.run_setup(37)
    close = runner._close

    def signalled(outcome):
        os.kill(os.getpid(), number)
        close(outcome)

    runner._close = signalled
    assert runner.run(TinyDataset()) == tmp_path
    assert runner.late_stop == number
    assert [p.name for p in folders(tmp_path)][-1] == "step-000000006"
