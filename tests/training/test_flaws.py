"""Bugs of upstream FluxVLA's training, one by one, where no other test is about just that.

``NUMBERS`` lists them all. Tests say which one they are about as "T4 of upstream's bugs".
"""

from __future__ import annotations

import ast
import inspect
import re
import sys
from pathlib import Path

import pytest
import torch

from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.checkpoints.checkpoint import Checkpoint, folders, latest
from fluxvla_core.data.mixture import DistributedRepeatingDataset
from fluxvla_core.data.sampler import StepPlan, StepSampler
from fluxvla_core.testing.training import (
    TinyDataset,
    checkpoint_differences,
    run_ranks,
    tiny_config,
    train,
    train_all,
    unflushed,
)
from fluxvla_core.training.distributed import start
from fluxvla_core.training.state import rank_seed

ROOT = Path(__file__).resolve().parents[2]
NUMBERS = [
    *(f"T{n}" for n in range(1, 14)),
    *(f"D{n}" for n in range(1, 4)),
    *(f"O{n}" for n in range(1, 4)),
    *(f"P{n}" for n in range(1, 3)),
]


@pytest.fixture(autouse=True)
def _fast():
    with unflushed():
        yield


def docstrings():
    for place in ("tests", "plugins"):
        for path in (ROOT / place).rglob("test_*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.FunctionDef | ast.ClassDef):
                    yield ast.get_docstring(node) or ""


def test_each_of_them_has_a_test_that_says_so():
    said = {
        number
        for text in docstrings()
        for listed in re.findall(r"((?:\b[TDOP]\d+\b(?:, | and )?)+) of upstream's bugs", text)
        for number in re.findall(r"[TDOP]\d+", listed)
    }
    assert [number for number in NUMBERS if number not in said] == []


def go_on(work_dir, kind, **settings):
    table = {"type": kind, "max_steps": 4, "ema_decay": 0.9, **settings}
    return {"config": tiny_config(table, batch=2), "work_dir": str(work_dir)}


def resumed_and_looked_at(run):
    """Go on with a run that is at its end: what is in memory then is what was loaded."""
    runner = train({**run, "resume": "auto"})
    for name, tensor in latest(run["work_dir"]).tensors("model.safetensors").items():
        assert torch.equal(runner.model.state_dict()[name], tensor), name
    state = latest(run["work_dir"]).tensors("optimizer.safetensors")
    named = {name: p for name, p in runner.model.named_parameters() if p.requires_grad}
    assert {n.rpartition("/")[0] for n in state} == set(named)
    for place, tensor in state.items():
        name, _, key = place.rpartition("/")
        assert torch.equal(runner.optimizer.state[named[name]][key], tensor), place


def test_every_rank_has_the_weights_and_the_optimizer_again(tmp_path):
    """T1 of upstream's bugs: a strategy's own resume() never restored the model's weights."""
    run = go_on(tmp_path, "DDPTrainRunner")
    assert run_ranks(2, train, run) == [0, 0]
    assert run_ranks(2, resumed_and_looked_at, run) == [0, 0]


@pytest.mark.parametrize("kind", ["OneProcessRunner", "DDPTrainRunner", "FSDPTrainRunner"])
@pytest.mark.parametrize("length", [{"max_steps": 5}, {"max_epochs": 1}])
def test_either_length_is_enough_and_its_end_is_saved(tmp_path, kind, length):
    """T4 and T5 of upstream's bugs: a default max_epochs tripped over max_steps; an interval
    beyond the end saved nothing.
    """
    config = tiny_config({"type": kind, "save_iter_interval": 1000, **length})
    train({"config": config, "work_dir": str(tmp_path)})
    assert [Checkpoint.open(f).step for f in folders(tmp_path)] == [length.get("max_steps", 10)]


def test_small_updates_are_not_lost_in_mixed_precision(tmp_path):
    """T6 of upstream's bugs: bf16 weights of 1.0 stood still under AdamW at a rate of 5e-5."""
    table = {"type": "OneProcessRunner", "max_steps": 20, "learning_rate": 5e-5}
    config = tiny_config({**table, "enable_mixed_precision_training": True, "weight_decay": 0.0})
    runner = train({"config": config, "work_dir": str(tmp_path)})
    norm = runner.model.blocks[0].norm.weight.detach()  # begins at 1.0
    assert norm.dtype == torch.float32
    assert (norm != 1.0).all()
    assert ((norm - 1.0).abs() < 2**-8).all()  # the next number of bf16 above 1.0


PICKLERS = {"pickle", "dill", "cloudpickle", "joblib", "shelve"}
PICKLING = {"torch.load", "torch.save", "pd.read_pickle", "allow_pickle=True"}


def pickling(source):
    """What in ``source`` reads or writes pickles, as (line, words)."""
    for node in ast.walk(ast.parse(source)):
        words = []
        if isinstance(node, ast.Import):
            words = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            words = [node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.Attribute | ast.keyword):
            words = [ast.unparse(node)]
        for word in words:
            if word.split(".")[0] in PICKLERS or word in PICKLING:
                yield node.lineno, word


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "import pickle as p",
        "from pickle import loads",
        "from torch import load",
        "torch.save(state, path)",
        "found = joblib.load(path)",
        "np.load(path, allow_pickle=True)",
    ],
)
def test_a_pickle_would_be_seen(source):
    assert {line for line, _ in pickling(source)} == {1}


# The published files of OpenVLA-OFT's heads and of torchvision's backbones are such;
# tests/data/test_no_code.py sees that they are read with weights_only=True.
PUBLISHED = {
    ROOT / "plugins/fluxvla-openvla/src/fluxvla_openvla/formats.py",
    ROOT / "src/fluxvla_core/checkpoints/foreign.py",
}


def test_nothing_reads_or_writes_a_pickle():
    """T9 and T11 of upstream's bugs: torch.save to the final name, torch.load on every rank."""
    places = [ROOT / "src", *(ROOT / "plugins").glob("*/src")]
    paths = [path for place in places for path in place.rglob("*.py")]
    assert len({path.relative_to(ROOT).parts[:2] for path in paths}) > 5
    found = [
        f"{path.relative_to(ROOT)}:{line}: {word}"
        for path in paths
        for line, word in pickling(path.read_text(encoding="utf-8"))
        if path not in PUBLISHED
    ]
    assert found == []


def test_merged_statistics_do_not_shrink_with_the_width():
    """D1 of upstream's bugs: the merged deviation was sqrt(D) too small."""
    import numpy as np

    from fluxvla_core.data.statistics import column_statistics

    rows = np.random.default_rng(0).standard_normal((4000, 14)) * np.arange(1, 15)
    found = np.asarray(column_statistics(rows)["std"])
    assert found == pytest.approx(rows.std(0), rel=1e-9)
    assert "pooled_statistics" in inspect.getsource(DistributedRepeatingDataset)


@pytest.mark.parametrize("workers", [0, 2])
def test_every_epoch_has_an_order_of_its_own(tmp_path, workers):
    """D2 of upstream's bugs: the same order in every epoch, with 0 workers whatever was asked."""
    seen = []

    class Watching(TinyDataset):
        def __len__(self):
            return 8

    def collate(samples):
        seen.append([int(s["sample_ids"]) for s in samples])
        return samples

    from fluxvla_core.data.loader import make_loader

    sampler = StepSampler(StepPlan(8, 4, seed=3))
    loader = iter(make_loader(Watching(8), list, sampler, workers))
    epochs = []
    for _ in range(2):
        batches = [next(loader) for _ in range(2)]
        epochs.append([int(s["sample_ids"]) for batch in batches for s in batch])
    loader.close()
    assert sorted(epochs[0]) == sorted(epochs[1]) == list(range(8))
    assert epochs[0] != epochs[1]


def test_ranks_of_two_machines_draw_different_numbers(monkeypatch):
    """D3 of upstream's bugs: LOCAL_RANK was taken for the rank, and was a KeyError when alone."""
    for name in ("RANK", "LOCAL_RANK", "WORLD_SIZE"):
        monkeypatch.delenv(name, raising=False)
    alone = start("cpu")
    assert (alone.rank, alone.size) == (0, 1)
    seeds = {rank_seed(42, rank) for rank in range(64)}
    assert len(seeds) == 64
    assert "LOCAL_RANK" not in inspect.getsource(sys.modules[rank_seed.__module__])


def test_ranks_do_not_draw_the_same_numbers(tmp_path):
    """Peers seed every rank alike, or give all of them rank 0's random state on resuming."""
    run = go_on(tmp_path, "DDPTrainRunner")
    assert run_ranks(2, train, run) == [0, 0]
    states = [latest(tmp_path).tensors(f"rng/rank-{r:05d}.safetensors") for r in (0, 1)]
    for name in ("torch", "numpy", "python"):
        assert not torch.equal(states[0][name], states[1][name]), name


def test_noise_belongs_to_the_sample_and_not_to_the_rank():
    """Peers drew equal flow-matching noise on every rank."""
    a, b = TinyDataset(), TinyDataset()
    assert (a.get_sample(3, 1)["noise"] == b.get_sample(3, 1)["noise"]).all()
    assert (a.get_sample(3, 1)["noise"] != a.get_sample(3, 2)["noise"]).any()
    assert (a.get_sample(3, 1)["noise"] != a.get_sample(4, 1)["noise"]).any()


def test_no_tracker_that_was_not_asked_for_is_touched(tmp_path, monkeypatch):
    """O2 of upstream's bugs: wandb.log was called whatever the trackers were; O1: a hard import."""
    for name in ("wandb", "tensorboard", "trackio"):
        monkeypatch.setitem(sys.modules, name, None)
    train(go_on(tmp_path, "DDPTrainRunner", max_steps=12))
    assert latest(tmp_path).step == 12


def test_the_device_is_waited_for_every_few_steps_only(tmp_path, monkeypatch):
    """Peers call loss.item() and grad_norm.item() in every step."""
    from fluxvla_core.training.step_metrics import StepMetrics

    fetched = []
    fetch = StepMetrics.fetch
    monkeypatch.setattr(StepMetrics, "fetch", lambda self: fetched.append(1) or fetch(self))
    waits = []
    item = torch.Tensor.item
    monkeypatch.setattr(torch.Tensor, "item", lambda self: waits.append(1) or item(self))
    train(go_on(tmp_path, "OneProcessRunner", max_steps=20, log_iter_interval=10))
    assert len(fetched) == 3  # at the first, the tenth and the last step
    assert len(waits) < 20


def test_plain_python_trains_without_a_gpu_or_a_launcher(tmp_path, monkeypatch):
    """P1 of upstream's bugs: without CUDA, NCCL and torchrun it died at the first barrier."""
    for name in ("RANK", "LOCAL_RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    world = train(go_on(tmp_path, "DDPTrainRunner")).world
    assert (world.rank, world.size, world.device.type) == (0, 1, "cpu")
    assert not torch.distributed.is_initialized()


def test_runners_and_operators_have_suites_that_need_no_gpu():
    """P2 of upstream's bugs: no test of a runner, an operator or of resuming."""
    from fluxvla_core.testing import operator, train_runner

    suites = [train_runner.TrainRunnerConformance, operator.OperatorConformance]
    for suite in suites:
        assert [name for name in dir(suite) if name.startswith("test_")]
        assert "cuda" not in inspect.getsource(suite)


def test_a_config_of_a_run_is_not_written_to(tmp_path):
    """Upstream's runners put themselves and what they make into the config that they were given."""
    config = tiny_config({"type": "OneProcessRunner", "max_steps": 1})
    before = repr(config)
    context = RunContext(config=config, section="runner", work_dir=tmp_path)
    runner = build_runner_from_cfg(config["runner"], context)
    runner.run_setup(37)
    runner.run(TinyDataset())
    assert repr(config) == before


def test_two_runs_in_one_process_do_not_know_of_each_other(tmp_path):
    """Upstream's seeds, loggers and process groups were left behind by an import or a run."""
    runs = [go_on(tmp_path / name, "OneProcessRunner") for name in "ab"]
    train_all(runs[0])
    train_all(runs[1])
    assert checkpoint_differences(*(folders(tmp_path / n)[-1] for n in "ab")) == []
