"""FSDPTrainRunner: what every train runner must do, and what is its own."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time

import pytest
import torch
from torch.distributed.tensor import DTensor

from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.errors import ConfigError
from fluxvla_core.testing.train_runner import TrainRunnerConformance
from fluxvla_core.testing.training import differences, run_ranks, tiny_config, train
from fluxvla_core.train.checkpoint import Checkpoint, folders, latest


class TestFSDPTrainRunner(TrainRunnerConformance):
    entry_point = "FSDPTrainRunner"


def build(work_dir, **settings):
    config = tiny_config({"type": "FSDPTrainRunner", "max_steps": 2, **settings})
    context = RunContext(config=config, section="runner", work_dir=work_dir)
    return build_runner_from_cfg(config["runner"], context)


def test_an_unknown_strategy_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="sharding_strategy 'full' is none of 'full-shard'"):
        build(tmp_path, sharding_strategy="full")


STRATEGIES = {
    "full-shard": {"mesh": [2], "rows": 4, "reshards": True},
    "shard-grad-op": {"mesh": [2], "rows": 4, "reshards": False},
    "hybrid-shard": {"mesh": [1, 2], "rows": 4, "reshards": True},
    "no-shard": {"mesh": [2, 1], "rows": 8, "reshards": False},
}


def every_strategy(work_dir):
    """Train with each; every rank writes down what it made of the model."""
    torch.distributed.init_process_group("gloo")
    for name in STRATEGIES:
        table = {"type": "FSDPTrainRunner", "max_steps": 6, "sharding_strategy": name}
        config = tiny_config(table, batch=2)
        model = train({"config": config, "work_dir": str(work_dir / name)}).model
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


def test_what_each_strategy_splits_and_that_all_train_alike(tmp_path):
    assert run_ranks(2, every_strategy, tmp_path) == [0, 0]
    for name, expected in STRATEGIES.items():
        for rank in range(2):
            assert json.loads((tmp_path / f"{name}-{rank}.json").read_text()) == expected
    first, *others = (latest(tmp_path / name).tensors("model.safetensors") for name in STRATEGIES)
    for other in others:
        assert all(torch.allclose(first[n], other[n], atol=1e-6) for n in first)


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


WORKER = """
import json, os, pathlib, sys
from fluxvla_core.testing.training import train
from fluxvla_core.cli.ranks import leave
settings = json.loads(pathlib.Path(sys.argv[1]).read_text())
folder = pathlib.Path(settings["work_dir"])
folder.mkdir(parents=True, exist_ok=True)
(folder / f"pid-{os.environ['RANK']}").write_text(str(os.getpid()))
train(settings)
leave(0)
"""


def launch(folder, settings):
    folder.mkdir(exist_ok=True)
    (folder / "worker.py").write_text(WORKER)
    (folder / "settings.json").write_text(json.dumps(settings))
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    command += ["--nproc_per_node=2", str(folder / "worker.py"), str(folder / "settings.json")]
    return subprocess.Popen(command, env={**os.environ, "OMP_NUM_THREADS": "1"})


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
