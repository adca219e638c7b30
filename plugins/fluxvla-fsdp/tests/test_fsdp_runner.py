"""FSDPTrainRunner: what every train runner must do, and what is its own."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from torch.distributed.tensor import DTensor

from fluxvla_core import build_runner_from_cfg
from fluxvla_core.checkpoints.checkpoint import Checkpoint, folders, latest
from fluxvla_core.errors import ConfigError
from fluxvla_core.operators import RunContext
from fluxvla_core.testing import TrainRunnerConformance
from fluxvla_core.testing.training import (
    checkpoint_differences,
    differences,
    run_ranks,
    tiny_config,
    train,
)


class TestFSDPTrainRunner(TrainRunnerConformance):
    entry_point = "FSDPTrainRunner"
    scalars = ("frozen",)


def build(work_dir, **settings):
    config = tiny_config({"type": "FSDPTrainRunner", "max_steps": 2, **settings})
    context = RunContext(config=config, section="runner", work_dir=work_dir)
    return build_runner_from_cfg(config["runner"], context)


def test_an_unknown_strategy_is_refused(tmp_path):
    with pytest.raises(
        ConfigError, match="unknown sharding_strategy 'full'; choose one of 'full-shard'"
    ):
        build(tmp_path, sharding_strategy="full")


STRATEGIES = {
    "full-shard": {"mesh": [2], "rows": 4, "reshards": True},
    "shard-grad-op": {"mesh": [2], "rows": 4, "reshards": False},
    "hybrid-shard": {"mesh": [1, 2], "rows": 4, "reshards": True},
    "no-shard": {"mesh": [2, 1], "rows": 8, "reshards": False},
}


def every_strategy(work_dir):
    """Train with each, also to go on from the middle; every rank writes down what it made of it."""
    torch.distributed.init_process_group("gloo")
    for name in STRATEGIES:
        table = {
            "type": "FSDPTrainRunner",
            "max_steps": 6,
            "save_iter_interval": 3,
            "sharding_strategy": name,
        }
        config = tiny_config(table, batch=2, dropout=0.0)
        model = train({"config": config, "work_dir": str(work_dir / name)}).model
        goes_on = tiny_config({**table, "max_keep_ckpts": 0}, batch=2, centred=True)
        whole, on = (str(work_dir / f"{name}-{part}") for part in ("whole", "on"))
        train({"config": goes_on, "work_dir": whole})
        train({"config": goes_on, "work_dir": on, "resume": str(folders(Path(whole))[0])})
        weight = model.blocks[0].linear.weight
        group = model.blocks[0]._get_fsdp_state()._fsdp_param_group
        sharded = {n for n, p in model.named_parameters() if isinstance(p, DTensor)}
        assert sharded == {n for n, p in model.named_parameters() if p.requires_grad}
        found = {
            "mesh": list(weight.device_mesh.shape),
            "rows": weight.to_local().shape[0],
            "reshards": group._reshard_after_forward,
        }
        rank = torch.distributed.get_rank()
        (work_dir / f"{name}-{rank}.json").write_text(json.dumps(found))


@pytest.fixture(scope="module")
def strategies(tmp_path_factory):
    work_dir = tmp_path_factory.mktemp("strategies")
    assert run_ranks(2, every_strategy, work_dir) == [0, 0]
    return work_dir


@pytest.mark.parametrize("name", STRATEGIES)
def test_what_a_strategy_splits(strategies, name):
    for rank in range(2):
        assert json.loads((strategies / f"{name}-{rank}.json").read_text()) == STRATEGIES[name]


@pytest.mark.parametrize("name", STRATEGIES)
def test_every_strategy_goes_on_bit_for_bit(strategies, name):
    whole, on = (latest(strategies / f"{name}-{part}").path for part in ("whole", "on"))
    assert checkpoint_differences(whole, on) == []


def test_all_strategies_train_as_one_process_does(strategies, tmp_path):
    config = tiny_config({"type": "OneProcessRunner", "max_steps": 6}, batch=4, dropout=0.0)
    train({"config": config, "work_dir": str(tmp_path)})
    alone = latest(tmp_path).tensors("model.safetensors")
    for name in STRATEGIES:
        found = latest(strategies / name).tensors("model.safetensors")
        gaps = [float((alone[n] - found[n]).abs().max()) for n in alone if n != "batches"]
        assert max(gaps) < 1e-5, name


def two_machines(work_dir):
    """Four processes, two to a machine: both machines hold the same two halves."""
    os.environ["LOCAL_WORLD_SIZE"] = "2"
    table = {"type": "FSDPTrainRunner", "max_steps": 6, "sharding_strategy": "hybrid-shard"}
    model = train({"config": tiny_config(table, batch=1, dropout=0.0), "work_dir": work_dir}).model
    weight = model.blocks[0].linear.weight
    assert (list(weight.device_mesh.shape), weight.to_local().shape[0]) == ([2, 2], 4)


def test_hybrid_over_two_machines_saves_every_part_once(strategies, tmp_path):
    assert run_ranks(4, two_machines, tmp_path) == [0] * 4
    saved = latest(tmp_path)
    parts = [n for n in saved.manifest.files if n.startswith("optimizer/")]
    assert parts == ["optimizer/rank-00000.safetensors", "optimizer/rank-00001.safetensors"]
    full = latest(strategies / "full-shard").tensors("model.safetensors")
    found = saved.tensors("model.safetensors")
    assert all(torch.allclose(full[n], found[n], atol=1e-5) for n in full if n != "batches")


def nodes(work_dir):
    os.environ["LOCAL_WORLD_SIZE"] = "3"
    build(work_dir, sharding_strategy="hybrid-shard").run_setup(37)


def test_hybrid_needs_equal_machines(tmp_path):
    assert run_ranks(2, nodes, tmp_path) == [1, 1]


def one_process(work_dir):
    config = tiny_config(
        {
            "type": "FSDPTrainRunner",
            "max_steps": 2,
            "enable_mixed_precision_training": True,
            "enable_gradient_checkpointing": True,
        }
    )
    train({"config": config, "work_dir": str(work_dir)})


def test_one_process_in_bf16_with_recomputing(tmp_path):
    assert run_ranks(1, one_process, tmp_path) == [0]
    tensors = latest(tmp_path).tensors("model.safetensors")
    assert {t.dtype for n, t in tensors.items() if n != "batches"} == {torch.float32}


def moved_whole(work_dir):
    """Torch moves a unit when it splits it: only what stays whole is moved here, at the end."""
    runner = build(work_dir)
    vla = runner._build_vla()
    frozen = [p.data_ptr() for p in vla.parameters() if not p.requires_grad]
    moved, to = [], torch.Tensor.to
    torch.Tensor.to = lambda t, *args, **kwargs: (
        moved.append(t.data_ptr()) or to(t, *args, **kwargs)
    )
    try:
        runner._wrap_model(vla)
    finally:
        torch.Tensor.to = to
    assert frozen
    assert sorted(moved) == sorted(frozen)


def test_no_device_holds_the_whole_model(tmp_path):
    assert run_ranks(1, moved_whole, tmp_path) == [0]


WORKER = """
import json, os, pathlib, sys
from fluxvla_core.testing.training import train
from fluxvla_core.cli.ranks import exit_now
settings = json.loads(pathlib.Path(sys.argv[1]).read_text())
folder = pathlib.Path(settings["work_dir"])
folder.mkdir(parents=True, exist_ok=True)
(folder / f"pid-{os.environ['RANK']}").write_text(str(os.getpid()))
train(settings)
exit_now(0)
"""


def launch(folder, settings):
    folder.mkdir(exist_ok=True)
    (folder / "worker.py").write_text(WORKER)
    (folder / "settings.json").write_text(json.dumps(settings))
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    command += ["--nproc_per_node=2", str(folder / "worker.py"), str(folder / "settings.json")]
    return subprocess.Popen(command, env={**os.environ, "OMP_NUM_THREADS": "1"})


@pytest.mark.slow
def test_torchrun_whose_worker_is_killed_at_a_random_moment(tmp_path):
    config = tiny_config(
        {"type": "FSDPTrainRunner", "max_steps": 120, "save_iter_interval": 10, "max_keep_ckpts": 0}
    )
    cut = {"config": config, "work_dir": str(tmp_path / "cut")}
    process = launch(tmp_path / "first", cut)
    deadline = time.monotonic() + 120
    while not folders(tmp_path / "cut") and time.monotonic() < deadline:
        time.sleep(0.02)
    time.sleep(random.random() / 2)
    os.kill(int((tmp_path / "cut/pid-1").read_text()), signal.SIGKILL)
    assert process.wait(timeout=120) != 0
    saved = folders(tmp_path / "cut")
    assert 0 < len(saved) < 13
    for folder in saved:
        Checkpoint.open(folder).verify()
    assert launch(tmp_path / "second", {**cut, "resume": "auto"}).wait(timeout=240) == 0
    whole = {"config": config, "work_dir": str(tmp_path / "whole")}
    assert run_ranks(2, train, whole) == [0, 0]
    assert differences(tmp_path / "whole", tmp_path / "cut") == []
