"""A checkpoint of so many processes goes on with another number of them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
import torch.distributed.checkpoint as dcp
from torch.distributed.checkpoint.hf_storage import HuggingFaceStorageReader

from fluxvla_core import build_runner_from_cfg
from fluxvla_core.checkpoints.checkpoint import MODEL, Checkpoint, folders
from fluxvla_core.checkpoints.tensors import read_tensors
from fluxvla_core.operators import RunContext
from fluxvla_core.testing.training import TinyDataset, run_ranks, tiny_config, train
from fluxvla_core.training import distributed
from fluxvla_core.training.stop import StopRequest
from fluxvla_core.training.trainer import Trainer

TOGETHER = 12
"""Samples of a step, over all processes."""


def config(ranks):
    table = {
        "type": "FSDPTrainRunner",
        "max_steps": 8,
        "save_iter_interval": 4,
        "max_keep_ckpts": 0,
        "ema_decay": 0.9,
        "weight_decay": 0.1,
        "lr_scheduler_type": "linear-warmup+cosine-decay",
    }
    return tiny_config(table, TOGETHER // ranks, dropout=0.0, width=7)


def reload(ranks, source, work_dir):
    """Save at once what was loaded, to ``work_dir/again``."""
    context = RunContext(
        config=config(ranks), section="runner", work_dir=work_dir / "loaded", resume=str(source)
    )
    runner = build_runner_from_cfg(context.config["runner"], context)
    dataset = TinyDataset()
    runner.run_setup(len(dataset))
    Trainer(runner, dataset, StopRequest(runner.world)).close()
    runner.save_checkpoint(work_dir / "again", runner.progress.step, 0)
    runner.finish_pending_save()
    distributed.stop(runner.world)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    place = tmp_path_factory.mktemp("runs")
    for ranks in (1, 2):
        run = {"config": config(ranks), "work_dir": place / str(ranks)}
        assert run_ranks(ranks, train, run) == [0] * ranks
    return place


def optimizer(checkpoint):
    stored = checkpoint.optimizer_tensors()
    return {n: t[tuple(slice(0, k) for k in t.shape)] for n, t in stored.items()}


def losses(work_dir):
    rows = [json.loads(line) for line in (work_dir / "metrics.jsonl").open()]
    return {row["step"]: row["loss"] for row in rows}


@pytest.mark.parametrize(("before", "after"), [(2, 1), (1, 2), (2, 3)])
def test_another_number_of_processes(runs, tmp_path, before, after):
    source = folders(runs / str(before))[0]
    assert run_ranks(after, reload, after, source, tmp_path) == [0] * after
    on = {"config": config(after), "work_dir": tmp_path / "on", "resume": str(source)}
    assert run_ranks(after, train, on) == [0] * after
    saved, again = Checkpoint.open(source), Checkpoint.open(tmp_path / "again")
    for read in (lambda c: c.tensors(MODEL), lambda c: c.tensors("ema.safetensors"), optimizer):
        ours, theirs = read(saved), read(again)
        assert ours.keys() == theirs.keys()
        assert all(torch.equal(ours[n], theirs[n]) for n in ours)
    assert saved.json("optimizer.json") == again.json("optimizer.json")
    # Losses follow from the samples of a step: another order would be far off.
    here, there = losses(tmp_path / "on"), losses(runs / str(before))
    assert sorted(here) == [5, 6, 7, 8]
    assert all(abs(here[step] - there[step]) < 1e-5 for step in here)
    ends = [Checkpoint.open(d).tensors(MODEL) for d in (tmp_path / "on", runs / str(before))]
    assert all(torch.allclose(ends[0][n], ends[1][n], atol=1e-5) for n in ends[0])


def test_which_files_hold_the_optimizer(runs):
    one, two = (Checkpoint.open(runs / n) for n in "12")
    assert [n for n in one.manifest.files if n.startswith("optimizer")] == [
        "optimizer.json",
        "optimizer.safetensors",
    ]
    assert [n for n in two.manifest.files if n.startswith("optimizer")] == [
        "optimizer.json",
        "optimizer/rank-00000.safetensors",
        "optimizer/rank-00001.safetensors",
    ]
    parts = [read_tensors(two.path / f"optimizer/rank-0000{rank}.safetensors") for rank in (0, 1)]
    assert [len(p["blocks.0.linear.weight/exp_avg"]) for p in parts] == [4, 3]
    assert ["blocks.0.linear.weight/step" in p for p in parts] == [True, False]


def test_torchs_own_reader_reads_the_parts(runs):
    saved = Checkpoint.open(runs / "2")
    expected = optimizer(saved)
    assert expected.keys() == optimizer(Checkpoint.open(runs / "1")).keys()
    state = {n: torch.full_like(t, -7.0) for n, t in expected.items() if t.ndim}
    assert len(state) == 20
    reader = HuggingFaceStorageReader(str(saved.path / "optimizer"))
    dcp.load(state, storage_reader=reader, no_dist=True)
    assert all(torch.equal(state[n], expected[n]) for n in state)


def test_no_file_of_a_checkpoint_is_a_pickle(runs):
    suffixes = {Path(name).suffix for name in Checkpoint.open(runs / "2").manifest.files}
    assert suffixes == {".json", ".safetensors"}
