"""Blocks that torch compiles: the same training, checkpoints and names, and it goes on exactly."""

from __future__ import annotations

import shutil
import signal
from pathlib import Path

import pytest
import torch

from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.checkpoints.checkpoint import folders, latest
from fluxvla_core.errors import ConfigError
from fluxvla_core.testing.training import (
    TinyDataset,
    TinyVLA,
    differences,
    run_ranks,
    tiny_config,
    train,
    train_all,
    unflushed,
)
from fluxvla_core.training.model import compile_units
from fluxvla_core.training.weights import load_for_inference

compiles = pytest.mark.skipif(
    shutil.which("gcc") is None and shutil.which("cc") is None and shutil.which("clang") is None,
    reason="torch.compile needs a C++ compiler",
)


@pytest.fixture(autouse=True)
def _fast():
    with unflushed():
        yield


def config_of(kind="OneProcessRunner", dropout=0.0, **settings):
    table = {"type": kind, "max_steps": 6, "compile_blocks": True, "max_keep_ckpts": 0, **settings}
    return tiny_config(table, batch=4, dropout=dropout)


def gap(a, b):
    pair = [latest(d).tensors("model.safetensors") for d in (a, b)]
    assert set(pair[0]) == set(pair[1])
    return max(float((pair[0][n] - pair[1][n]).abs().max()) for n in pair[0])


@compiles
@pytest.mark.parametrize("checkpointing", [pytest.param(False, marks=pytest.mark.slow), True])
def test_it_trains_as_the_plain_model_does(tmp_path, checkpointing):
    """Compiled blocks and recomputed activations broke each other elsewhere."""
    config = config_of(enable_gradient_checkpointing=checkpointing)
    runner = train({"config": config, "work_dir": str(tmp_path / "compiled")})
    assert all("forward" in unit.__dict__ for unit in runner.model.fsdp_units())
    plain = {**config, "runner": {**config["runner"], "compile_blocks": False}}
    train({"config": plain, "work_dir": str(tmp_path / "plain")})
    assert gap(tmp_path / "compiled", tmp_path / "plain") < 1e-5


@compiles
def test_its_checkpoint_acts_without_compiling_and_compiled(tmp_path):
    train({"config": config_of(), "work_dir": str(tmp_path)})
    samples = [TinyDataset().get_sample(i, 0) for i in range(4)]
    batch = {k: torch.stack([torch.as_tensor(s[k]) for s in samples]) for k in samples[0]}
    found = []
    for again in (False, True):
        model = TinyVLA(dropout=0.0).eval()
        load_for_inference(model, latest(tmp_path))
        if again:
            compile_units(model)
        with torch.inference_mode():
            found.append(float(model(**batch)["loss"]))
    assert found[0] == pytest.approx(found[1], rel=1e-5)


@compiles
@pytest.mark.parametrize(
    "kind",
    [
        "OneProcessRunner",
        pytest.param("DDPTrainRunner", marks=pytest.mark.slow),
        pytest.param("FSDPTrainRunner", marks=pytest.mark.slow),
    ],
)
def test_it_goes_on_bit_for_bit(tmp_path, kind):
    """With dropout, which compiled code draws in its own way."""
    ranks = 1 if kind == "OneProcessRunner" else 2
    config = config_of(kind, dropout=0.1, save_iter_interval=3)
    whole, cut = ({"config": config, "work_dir": str(tmp_path / name)} for name in "ab")
    killed = {**cut, "signal": (ranks - 1, 5, signal.SIGKILL)}
    codes = run_ranks(ranks, train_all, whole, killed, timeout=600)
    assert codes[-1] == -signal.SIGKILL
    assert run_ranks(ranks, train, {**cut, "resume": "auto"}, timeout=600) == [0] * ranks
    assert [p.name for p in folders(tmp_path / "b")] == ["step-000000003", "step-000000006"]
    assert differences(tmp_path / "a", tmp_path / "b") == []


def test_a_model_without_blocks_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(TinyVLA, "fsdp_units", lambda self: [])
    config = config_of()
    context = RunContext(config=config, section="runner", work_dir=Path(tmp_path))
    runner = build_runner_from_cfg(config["runner"], context)
    with pytest.raises(ConfigError, match="compile_blocks: TinyVLA names no blocks to compile"):
        runner.run_setup(37)
