"""GR00T trains: alike on one process and on several, and on from a checkpoint bit for bit."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fluxvla_gr00t.gr00t import GR00T

from fluxvla_core.testing.training import (
    TinyDataset,
    assert_trained_alike,
    checkpoint_differences,
    run_ranks,
    tiny_config,
    train,
)
from fluxvla_core.training.cost import fake, fake_activations, saved_activations
from tests.oracles import fill

from .gr00t_sizes import PLACE, TINY_N15, TINY_N17

KEYS = (
    "images",
    "img_masks",
    "lang_tokens",
    "lang_masks",
    "states",
    "actions",
    "action_masks",
    "noise",
    "time",
    "embodiment_ids",
)
MODELS = {"n1.5": TINY_N15, "n1.7": TINY_N17}
SIDES = {"n1.5": 28, "n1.7": 16}
# Runner, version, settings of the model and of the runner.
RUNS = {
    "fsdp-n1.5": (
        "FSDPTrainRunner",
        "n1.5",
        {"freeze_vlm_backbone": False},
        {"enable_gradient_checkpointing": True},
    ),
    "fsdp-n1.7": ("FSDPTrainRunner", "n1.7", {"freeze_vlm_backbone": False}, {}),
    "fsdp-n1.7-frozen": ("FSDPTrainRunner", "n1.7", {}, {}),
    "ddp-n1.5": ("DDPTrainRunner", "n1.5", {"freeze_vlm_backbone": False}, {}),
    "ddp-n1.5-frozen": ("DDPTrainRunner", "n1.5", {}, {}),
    "ddp-n1.7": ("DDPTrainRunner", "n1.7", {"freeze_vlm_backbone": False}, {}),
}


class Samples(TinyDataset):
    """Two images, words of different lengths, robots of different kinds, ends of episodes."""

    def __init__(self, version):
        super().__init__(12)
        self.side = SIDES[version]

    def get_sample(self, index, epoch):
        words = fill.integers(f"words {index}", (7,), PLACE)
        places = np.full(4, PLACE)
        seen = np.arange(15) >= index % 4
        return {
            "images": fill.normal(f"pictures {index}", (6, self.side, self.side)),
            # The second camera is absent now and then.
            "img_masks": np.array([True, index % 3 > 0]),
            "lang_tokens": np.concatenate([words[:4], places, words[4:5], places, words[5:]]),
            "lang_masks": seen,
            "states": fill.normal(f"states {index}", (7,)),
            "actions": fill.normal(f"actions {index}", (6, 5)),
            "action_masks": (np.arange(6) < 6 - index % 3).astype(np.float32),
            "noise": fill.normal(f"noise {index} {epoch}", (2, 6, 5)),
            "time": fill.uniform(f"time {index} {epoch}", (2,)),
            "embodiment_ids": np.int64(index % 3),
        }


def run(name, kind, batch, work_dir, resume=None, head=None, **more):
    _, version, model, settings = RUNS[name]
    table = {
        "type": kind,
        "max_steps": 20,
        "save_iter_interval": 10,
        "max_keep_ckpts": 0,
        "max_grad_norm": 1.0,
        "learning_rate": 1e-3,
        "collator": {"type": "DictCollator", "keys": list(KEYS)},
        **(settings if kind != "OneProcessRunner" else {}),
        **more,
    }
    config = tiny_config(table, batch)
    tiny = MODELS[version]
    config["model"] = {**tiny, "vla_head": {**tiny["vla_head"], **(head or {})}, **model}
    run = {"config": config, "work_dir": work_dir, "resume": resume, "dataset": Samples(version)}
    train(run)


def every_run(work_dir):
    torch.distributed.init_process_group("gloo")
    for name, (kind, *_) in RUNS.items():
        run(name, kind, 2, work_dir / name)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    work_dir = tmp_path_factory.mktemp("gr00t")
    assert run_ranks(2, every_run, work_dir) == [0, 0]
    return work_dir


@pytest.mark.parametrize("name", RUNS)
def test_two_processes_train_as_one_does(trained, name, tmp_path):
    run(name, "OneProcessRunner", 4, tmp_path)
    assert_trained_alike(trained / name, tmp_path)


def test_it_goes_on_bit_for_bit_with_its_dropout(tmp_path):
    head = {"dropout": 0.2, "state_dropout": 0.3}
    both = {"head": head, "save_iter_interval": 2, "max_steps": 4}
    run("fsdp-n1.5", "OneProcessRunner", 4, tmp_path / "whole", **both)
    first, last = sorted((tmp_path / "whole" / "checkpoints").glob("step-*"))
    run("fsdp-n1.5", "OneProcessRunner", 4, tmp_path / "on", resume=str(first), **both)
    (again,) = sorted((tmp_path / "on" / "checkpoints").glob("step-*"))[-1:]
    assert checkpoint_differences(last, again) == []


@pytest.mark.parametrize(("version", "frozen"), [("n1.5", False), ("n1.7", True)])
def test_it_learns_a_batch_and_only_what_is_not_frozen_moves(version, frozen):
    torch.manual_seed(0)
    tiny = MODELS[version]
    model = GR00T(tiny["vlm_backbone"], tiny["vla_head"], frozen).train()
    before = {name: p.detach().clone() for name, p in model.named_parameters()}
    samples = [Samples(version).get_sample(i, 0) for i in range(2)]
    batch = {k: torch.from_numpy(np.stack([sample[k] for sample in samples])) for k in KEYS}
    optimizer = torch.optim.AdamW([p for p in model.parameters() if p.requires_grad], 3e-3)
    losses = []
    for _ in range(70):
        optimizer.zero_grad()
        loss = model(**batch)["loss"]
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert min(losses[-20:]) < 0.7 * losses[0]
    still = {n for n, p in model.named_parameters() if torch.equal(p, before[n])}
    assert still == {n for n in before if frozen and n.startswith("vlm_backbone.")}


@pytest.mark.parametrize("dtype", [None, torch.bfloat16], ids=["float32", "bfloat16"])
@pytest.mark.parametrize(
    ("version", "frozen"),
    # Of N1.7 as a whole transformers reads the values of tokens.
    [("n1.5", True), ("n1.5", False), ("n1.7", True)],
)
def test_a_dry_run_counts_what_its_training_keeps(version, frozen, dtype):
    def made():
        tiny = MODELS[version]
        return GR00T(tiny["vlm_backbone"], tiny["vla_head"], frozen).train()

    with torch.device("meta"):
        bare = made()
    samples = [Samples(version).get_sample(i, 0) for i in range(3)]
    batch = {k: torch.from_numpy(np.stack([sample[k] for sample in samples])) for k in KEYS}
    estimate, found = (
        fake_activations(fake(bare), batch, dtype),
        saved_activations(made(), batch, dtype),
    )
    assert found.activations > 0
    assert estimate.activations == pytest.approx(found.activations, rel=0.01)
    assert estimate.recomputed == pytest.approx(found.recomputed, rel=0.01)
    assert estimate.weight_copies == found.weight_copies
