"""DeepSpeedTrainRunner: the same training as in one process, in every stage, and exact resume."""

from __future__ import annotations

import json
import os
from importlib.util import find_spec

import pytest
import torch

from fluxvla_core import VLAS, build_runner_from_cfg
from fluxvla_core.checkpoints.checkpoint import folders, latest
from fluxvla_core.errors import ConfigError, RunFailed
from fluxvla_core.operators import RunContext
from fluxvla_core.testing import TrainRunnerConformance
from fluxvla_core.testing.training import (
    TinyVLA,
    checkpoint_differences,
    run_ranks,
    tiny_config,
    train,
)

installed = pytest.mark.skipif(find_spec("deepspeed") is None, reason="DeepSpeed is not installed")
STAGES = (1, 2, 3)


@installed
@pytest.mark.slow
class TestDeepSpeedTrainRunner(TrainRunnerConformance):
    """Every start of processes imports DeepSpeed for seconds: at night only."""

    entry_point = "DeepSpeedTrainRunner"
    scalars = ()


def config(batch=2, centred=False, **settings):
    table = {
        "max_steps": 6,
        "save_iter_interval": 3,
        "weight_decay": 0.1,
        "max_grad_norm": 0.5,
        "grad_accumulation_steps": 2,
        "lr_scheduler_type": "linear-warmup+cosine-decay",
        **settings,
    }
    model = {"width": 7, "assorted": True, "centred": centred, "batch_norm": centred}
    return tiny_config(table, batch, dropout=0.0, **model)


def every_stage(work_dir, stages=STAGES):
    """Train with each stage, and again from its own middle and from that of one process."""
    torch.distributed.init_process_group("gloo")
    for stage in stages:
        table = {"type": "DeepSpeedTrainRunner", "zero_stage": stage}
        runs = {f"{stage}": None, f"{stage}-on": f"{stage}", f"{stage}-from-one": "one"}
        for name, before in runs.items():
            resume = None if before is None else str(folders(work_dir / before)[0])
            run = {"config": config(**table), "work_dir": str(work_dir / name), "resume": resume}
            train(run)
        for part, before in {"centred": None, "centred-on": "centred"}.items():
            resume = before and str(folders(work_dir / f"{stage}-{before}")[0])
            run = {"config": config(centred=True, **table), "resume": resume}
            train({**run, "work_dir": str(work_dir / f"{stage}-{part}")})


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    work_dir = tmp_path_factory.mktemp("stages")
    one = config(4, type="OneProcessRunner")
    train({"config": one, "work_dir": str(work_dir / "one")})
    assert run_ranks(2, every_stage, work_dir) == [0, 0]
    for stage in STAGES:
        resume = str(folders(work_dir / f"{stage}")[0])
        train({"config": one, "work_dir": str(work_dir / f"one-from-{stage}"), "resume": resume})
    return work_dir


def alone(work_dir):
    """One process that nobody launched, on from a run with a layer that never had a gradient."""
    for name in ("RANK", "LOCAL_RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE"):
        os.environ.pop(name, None)
    resume = str(folders(work_dir / "spare")[0])
    config = spared(type="DeepSpeedTrainRunner")
    run = {"config": config, "work_dir": str(work_dir / "spare-on"), "resume": resume}
    train(run)


def spared(**table):
    settings = {"max_steps": 6, "save_iter_interval": 3, **table}
    return tiny_config(settings, 4, dropout=0.0, spare=True)


@installed
def test_one_process_that_nobody_launched_goes_on_with_what_state_there_is(tmp_path):
    """``fluxvla run`` as it is; ``spare`` has no moments in the checkpoint of the run before."""
    train({"config": spared(type="OneProcessRunner"), "work_dir": str(tmp_path / "spare")})
    assert run_ranks(1, alone, tmp_path) == [0]
    assert gap(tmp_path / "spare", tmp_path / "spare-on") < 1e-5


def gap(a, b):
    ours, theirs = (latest(d).tensors("model.safetensors") for d in (a, b))
    assert ours.keys() == theirs.keys()
    return max(float((ours[n] - theirs[n]).abs().max()) for n in ours if n != "batches")


@installed
@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.parametrize("kind", ["", "-centred"])
def test_a_stage_goes_on_bit_for_bit(runs, stage, kind):
    """With buffers that every process changes by its own batches too."""
    whole, on = (latest(runs / d).path for d in (f"{stage}{kind}", f"{stage}{kind}-on"))
    assert checkpoint_differences(whole, on) == []


@installed
@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_trains_as_one_process_does(runs, stage):
    assert gap(runs / f"{stage}", runs / "one") < 1e-5
    rows = [
        [json.loads(line) for line in (runs / d / "metrics.jsonl").open()]
        for d in (f"{stage}", "one")
    ]
    for ours, theirs in zip(*rows, strict=True):
        assert ours["lr"] == theirs["lr"]
        assert abs(ours["loss"] - theirs["loss"]) < 1e-5
        assert abs(ours["grad_norm"] - theirs["grad_norm"]) < 1e-4


@installed
@pytest.mark.parametrize("stage", STAGES)
def test_checkpoints_go_to_one_process_and_back(runs, stage):
    assert gap(runs / f"{stage}-from-one", runs / "one") < 1e-5
    assert gap(runs / f"one-from-{stage}", runs / "one") < 1e-5
    ours, theirs = (folders(runs / d)[0] for d in (f"{stage}", "one"))
    names = [{p.relative_to(d).as_posix() for p in d.rglob("*")} for d in (ours, theirs)]
    assert names[0] - names[1] == {"rng/rank-00001.safetensors"}


@VLAS.register_module()
class SteepForAllVLA(TinyVLA):
    """From its third batch on the gradient is not finite, though the loss is."""

    def forward(self, **batch):
        output = super().forward(**batch)
        floor = float(self.batches < 3)
        return {"loss": output["loss"] + (floor + 0.0 * self.head.bias.sum()).sqrt()}


def steep(work_dir):
    """Without clipping, each stage over a gradient that is not finite."""
    torch.distributed.init_process_group("gloo")
    for stage in STAGES:
        table = {"type": "DeepSpeedTrainRunner", "zero_stage": stage, "max_grad_norm": None}
        tree = config(**table, grad_accumulation_steps=1, save_iter_interval=1)
        tree["model"] = {**tree["model"], "type": "SteepForAllVLA"}
        try:
            train({"config": tree, "work_dir": str(work_dir / f"{stage}")})
        except RunFailed as error:
            (work_dir / f"{stage}.{torch.distributed.get_rank()}").write_text(error.what)


@installed
def test_without_clipping_a_gradient_that_is_not_finite_ends_the_run(tmp_path):
    assert run_ranks(2, steep, tmp_path) == [0, 0]
    for stage in STAGES:
        for rank in range(2):
            said = (tmp_path / f"{stage}.{rank}").read_text()
            assert said.startswith("the gradient norm is inf at step 3, with loss")
        rows = [json.loads(line) for line in (tmp_path / f"{stage}/metrics.jsonl").open()]
        assert [row["step"] for row in rows] == [1, 2]
        assert all(row["grad_norm"] > 0 for row in rows)
        assert [p.name for p in folders(tmp_path / f"{stage}")][-1] == "step-000000002"


def build(work_dir, **settings):
    tree = config(type="DeepSpeedTrainRunner", **settings)
    context = RunContext(config=tree, section="runner", work_dir=work_dir)
    return build_runner_from_cfg(tree["runner"], context)


def test_unknown_stages_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="zero_stage must be 1, 2 or 3, got 4"):
        build(tmp_path, zero_stage=4)


def test_averages_need_whole_weights(tmp_path):
    with pytest.raises(ConfigError, match="ema_decay does not go together with zero_stage 3"):
        build(tmp_path, zero_stage=3, ema_decay=0.9)


def test_without_deepspeed_the_command_that_brings_it_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("fluxvla_deepspeed.runner.find_spec", lambda name: None)
    with pytest.raises(ConfigError) as caught:
        build(tmp_path)
    assert "needs the package deepspeed, which is not installed" in str(caught.value)
    assert "pip install 'fluxvla-deepspeed[deepspeed]'" in str(caught.value)
