"""Gradients that are not finite end a run, whether or not they are clipped and by whom."""

from __future__ import annotations

import json
import re

import pytest
import torch

from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.checkpoints.checkpoint import folders
from fluxvla_core.data.sampler import epoch_order
from fluxvla_core.errors import RunFailed
from fluxvla_core.plugins.registry import RUNNERS, VLAS
from fluxvla_core.testing.training import (
    OneProcessRunner,
    TinyDataset,
    TinyVLA,
    run_ranks,
    tiny_config,
    train,
    unflushed,
)


@VLAS.register_module()
class SteepVLA(TinyVLA):
    """The loss of its ``steep``-th batch is finite, and its gradient is not."""

    def __init__(self, steep=3, **settings):
        super().__init__(**settings)
        self.steep = steep

    def forward(self, **batch):
        output = super().forward(**batch)
        floor = float(not self.training or self.batches != self.steep)
        return {"loss": output["loss"] + (floor + 0.0 * self.head.bias.sum()).sqrt()}


@RUNNERS.register_module()
class UntoldRunner(OneProcessRunner):
    """Clips as the specification's runner does, which tells no norm."""

    def clip_grad_norm(self):
        torch.nn.utils.clip_grad_norm_(self.vla.parameters(), max_norm=1.0)


def config(kind, batch=4, steep=3, **settings):
    table = {"type": kind, "max_steps": 6, "save_iter_interval": 1, "max_keep_ckpts": 0}
    tree = tiny_config({**table, **settings}, batch, dropout=0.0)
    tree["model"] = {**tree["model"], "type": "SteepVLA", "steep": steep}
    return tree


class Seen(TinyDataset):
    """Notes which samples it was asked for."""

    def __init__(self):
        super().__init__()
        self.asked = []

    def get_sample(self, index, epoch):
        self.asked.append(index)
        return super().get_sample(index, epoch)


def begin(tree, work_dir, dataset):
    context = RunContext(config=tree, section="runner", work_dir=work_dir)
    runner = build_runner_from_cfg(tree["runner"], context)
    runner.run_setup(37)
    runner.run(dataset)


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        ("OneProcessRunner", {}),
        ("OneProcessRunner", {"max_grad_norm": None}),
        ("UntoldRunner", {}),
    ],
)
def test_a_gradient_that_is_not_finite_spoils_no_checkpoint(tmp_path, kind, settings):
    dataset = Seen()
    with unflushed(), pytest.raises(RunFailed) as caught:
        begin(config(kind, **settings), tmp_path, dataset)
    first, second = caught.value.what.splitlines()
    assert first.startswith("the gradient norm is nan at step 3, with loss")
    assert second == f"    rank 0: samples {dataset.asked[8:12]}"
    assert [p.name for p in folders(tmp_path)] == ["step-000000001", "step-000000002"]


def norms(work_dir):
    return [json.loads(line)["grad_norm"] for line in (work_dir / "metrics.jsonl").open()]


def two_ranks(work_dir, kinds):
    torch.distributed.init_process_group("gloo")
    for kind in kinds:
        without = {"max_grad_norm": None, "log_iter_interval": 2}
        train({"config": config(kind, 2, -1, **without), "work_dir": str(work_dir / kind)})
        try:
            train({"config": config(kind, 2, **without), "work_dir": str(work_dir / f"{kind}-bad")})
        except RunFailed as error:
            (work_dir / f"{kind}-{torch.distributed.get_rank()}").write_text(error.what)


def test_strategies_tell_the_norm_without_clipping(tmp_path):
    with unflushed():
        one = config("OneProcessRunner", 4, -1, max_grad_norm=1e9)
        train({"config": one, "work_dir": str(tmp_path / "one")})
    third = sorted(epoch_order(37, 42, 0)[8:12])
    kinds = ("DDPTrainRunner", "FSDPTrainRunner")
    assert run_ranks(2, two_ranks, tmp_path, kinds) == [0, 0]
    for kind in kinds:
        assert norms(tmp_path / kind) == pytest.approx(norms(tmp_path / "one"), rel=1e-4)
        assert [p.name for p in folders(tmp_path / f"{kind}-bad")][-1] == "step-000000002"
        for rank in range(2):
            said = (tmp_path / f"{kind}-{rank}").read_text()
            assert said.startswith("the gradient norm is nan at step 3, with loss")
            listed = re.findall(r"^    rank (\d): samples \[(\d+), (\d+)\]$", said, re.MULTILINE)
            assert [rank for rank, *_ in listed] == ["0", "1"]
            assert sorted(int(i) for _, *ids in listed for i in ids) == third
