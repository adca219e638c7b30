"""DDPTrainRunner: what every train runner must do, and what is its own."""

from __future__ import annotations

import os
import signal

import pytest
import torch
from fluxvla_ddp.runner import DDPTrainRunner

from fluxvla_core.checkpoints.checkpoint import latest
from fluxvla_core.errors import ConfigError
from fluxvla_core.testing import TrainRunnerConformance
from fluxvla_core.testing.training import (
    TinyVLA,
    differences,
    run_ranks,
    tiny_config,
    train,
    train_all,
)


class TestDDPTrainRunner(TrainRunnerConformance):
    """T1 of upstream's bugs: resuming never restored the weights."""

    entry_point = "DDPTrainRunner"


def test_three_ranks_go_on_bit_for_bit_too(tmp_path):
    """With more than two summands the order in which buckets are added up shows."""
    config = tiny_config(
        {"type": "DDPTrainRunner", "max_steps": 8, "save_iter_interval": 4, "max_keep_ckpts": 0},
        batch=2,
        width=64,
    )
    whole, cut = ({"config": config, "work_dir": str(tmp_path / name)} for name in "ab")
    assert run_ranks(3, train_all, whole, {**cut, "signal": (2, 6, signal.SIGKILL)})[2] == -9
    assert run_ranks(3, train, {**cut, "resume": "auto"}) == [0, 0, 0]
    assert differences(tmp_path / "a", tmp_path / "b") == []


def test_one_process_needs_no_group(tmp_path):
    config = tiny_config({"type": "DDPTrainRunner", "max_steps": 2})
    runner = train({"config": config, "work_dir": str(tmp_path)})
    assert type(runner.vla).__name__ == "TinyVLA"


def unused(work_dir, find):
    config = tiny_config(
        {"type": "DDPTrainRunner", "max_steps": 3, "find_unused_parameters": find}, spare=True
    )
    train({"config": config, "work_dir": str(work_dir)})


def test_parameters_that_a_step_leaves_out_need_to_be_looked_for(tmp_path):
    assert run_ranks(2, unused, tmp_path / "find", True) == [0, 0]
    assert run_ranks(2, unused, tmp_path / "not", False) == [1, 1]


def accumulated(work_dir, batch, parts):
    """Train, and write down how often gradients were kept back instead of exchanged."""
    kept = []
    no_sync = torch.nn.parallel.DistributedDataParallel.no_sync
    torch.nn.parallel.DistributedDataParallel.no_sync = lambda self: kept.append(1) or no_sync(self)
    table = {"type": "DDPTrainRunner", "max_steps": 5, "grad_accumulation_steps": parts}
    train({"config": tiny_config(table, batch, dropout=0.0), "work_dir": str(work_dir)})
    (work_dir / f"kept-{os.environ['RANK']}").write_text(str(len(kept)))


def test_accumulation_equals_the_big_batch_and_exchanges_once_a_step(tmp_path):
    """Three of four backward passes keep their gradients; the fourth exchanges the sum."""
    for name, batch, parts in (("big", 8, 1), ("split", 2, 4)):
        assert run_ranks(2, accumulated, tmp_path / name, batch, parts) == [0, 0]
        kept = [(tmp_path / name / f"kept-{rank}").read_text() for rank in (0, 1)]
        assert kept == [str(5 * (parts - 1))] * 2
    big, split = (latest(tmp_path / d).tensors("model.safetensors") for d in ("big", "split"))
    for name in big:
        if name != "batches":
            assert torch.allclose(big[name], split[name], atol=2e-5), name


STATIC = {"type": "DDPTrainRunner", "max_steps": 6, "static_graph": True}


def same_weights(left, right):
    ours, theirs = (latest(folder).tensors("model.safetensors") for folder in (left, right))
    return all(torch.allclose(ours[name], theirs[name], atol=1e-6) for name in ours)


@pytest.mark.parametrize("parts", [1, 2])
def test_a_static_graph_trains_the_same_weights(tmp_path, parts):
    table = {**STATIC, "grad_accumulation_steps": parts}
    runs = {"static": table, "not": {**table, "static_graph": False}}
    settings = [
        {"config": tiny_config(runs[name], 4), "work_dir": str(tmp_path / name)} for name in runs
    ]
    assert run_ranks(2, train_all, *settings) == [0, 0]
    assert same_weights(tmp_path / "static", tmp_path / "not")


def test_a_static_graph_goes_on_bit_for_bit(tmp_path):
    table = {**STATIC, "save_iter_interval": 3, "max_keep_ckpts": 0}
    config = tiny_config(table, batch=2, width=64)
    whole, cut = ({"config": config, "work_dir": str(tmp_path / name)} for name in "ab")
    assert run_ranks(3, train_all, whole, {**cut, "signal": (2, 5, signal.SIGKILL)})[2] == -9
    assert run_ranks(3, train, {**cut, "resume": "auto"}) == [0, 0, 0]
    assert differences(tmp_path / "a", tmp_path / "b") == []


def test_a_static_graph_may_leave_out_the_same_parameters_each_step(tmp_path):
    config = tiny_config(STATIC, spare=True)
    assert run_ranks(2, train, {"config": config, "work_dir": str(tmp_path)}) == [0, 0]


def built(work_dir, declares, table):
    TinyVLA.static_graph = declares
    runner = train({"config": tiny_config(table), "work_dir": str(work_dir)})
    (work_dir / "static").write_text(str(runner.vla.static_graph))


@pytest.mark.parametrize(
    ("declares", "settings", "static"),
    [
        (True, {}, "True"),
        (False, {}, "False"),
        (True, {"static_graph": False}, "False"),
        (True, {"find_unused_parameters": True}, "False"),
    ],
)
def test_the_model_says_whether_its_graph_is_static(tmp_path, declares, settings, static):
    table = {"type": "DDPTrainRunner", "max_steps": 1, **settings}
    assert run_ranks(2, built, tmp_path, declares, table) == [0, 0]
    assert (tmp_path / "static").read_text() == static


def test_a_graph_is_not_static_and_searched_at_once():
    with pytest.raises(ConfigError, match="exclude each other"):
        DDPTrainRunner(max_steps=1, static_graph=True, find_unused_parameters=True)
