"""SmolVLA trains: the loss falls, several processes do as one does, and it resumes bit for bit."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import pytest
import torch
from fluxvla_smolvla.lerobot_files import published

from fluxvla_core.checkpoints.checkpoint import folders, latest
from fluxvla_core.testing.training import (
    assert_trained_alike,
    checkpoint_differences,
    losses,
    run_ranks,
    train,
)
from tests.training.held_memory import check_held

from .tiny import ACTION, HORIZON, SIZES, STATE, WIDTH, lerobot_folder, published_weights

KEYS = [
    "images",
    "img_masks",
    "lang_tokens",
    "lang_masks",
    "states",
    "actions",
    "action_masks",
    "noise",
    "time",
]


class Samples:
    """Ten samples, each always with the same noise; some end within the chunk."""

    fps = 10.0
    statistics: ClassVar[dict] = {"private": {}}
    embodiment = None

    def __len__(self):
        return 10

    def get_sample(self, index, epoch):
        rng = np.random.default_rng(index)
        shape = (HORIZON, WIDTH)
        actions, states = np.zeros(shape, np.float32), np.zeros(WIDTH, np.float32)
        actions[:, :ACTION] = rng.standard_normal((HORIZON, ACTION))
        states[:STATE] = rng.standard_normal(STATE)
        return {
            "images": rng.uniform(-1, 1, (6, 64, 64)).astype(np.float32),
            "img_masks": np.array([True, index % 2 == 0]),
            "lang_tokens": rng.integers(0, 300, 6),
            "lang_masks": np.arange(6) < 3 + index % 4,
            "states": states,
            "actions": actions,
            "action_masks": (np.arange(HORIZON) < 4 + index % 4).astype(np.float32),
            "noise": rng.standard_normal((1, *shape)).astype(np.float32),
            "time": rng.uniform(0, 0.999, 1).astype(np.float32),
        }


def config_of(runner, batch, model=None, **settings):
    """Of a training of four steps."""
    table = {
        "type": runner,
        "learning_rate": 1e-4,
        "max_steps": 4,
        "seed": 1,
        "collator": {"type": "DictCollator", "keys": KEYS},
        **settings,
    }
    return {
        "model": {"type": "SmolVLA", **SIZES, "loss_mean": "all", **(model or {})},
        "train_dataloader": {"per_device_batch_size": batch},
        "runner": table,
    }


def learn(work_dir, runner="OneProcessRunner", batch=4, resume=None, model=None, **settings):
    """One training; gives the work dir."""
    config = config_of(runner, batch, model, **settings)
    train({"config": config, "work_dir": work_dir, "resume": resume, "dataset": Samples()})
    return work_dir


def test_the_loss_falls_with_the_expert_alone(tmp_path):
    found = losses(learn(tmp_path, max_steps=80, batch=5, learning_rate=1e-3))
    assert np.mean(found[-5:]) < 0.3 * np.mean(found[:5])


def test_a_training_starts_from_lerobots_folder(tmp_path):
    source = lerobot_folder(tmp_path / "theirs")
    model = {"pretrained_name_or_path": str(source), "n_action_steps": HORIZON, "num_steps": 2}
    learn(tmp_path / "run", model=model, max_steps=1, learning_rate=1e-9)
    found = latest(tmp_path / "run").tensors("model.safetensors")
    ours = {published(name): tensor for name, tensor in found.items()}
    for name, tensor in published_weights().items():
        torch.testing.assert_close(ours[name], tensor, rtol=0, atol=1e-8)


PARTS = {
    "expert": {},
    "language": {"train_expert_only": False},
}


LONG = {"max_steps": 20, "save_iter_interval": 10, "max_keep_ckpts": 0}


def on_two(work_dir):
    torch.distributed.init_process_group("gloo")
    mixed = {"model": PARTS["language"], "enable_mixed_precision_training": True}
    learn(work_dir / "bf16", "FSDPTrainRunner", batch=2, **mixed)
    for part, model in PARTS.items():
        for runner in ("DDPTrainRunner", "FSDPTrainRunner"):
            learn(work_dir / f"{part}-{runner}", runner, batch=2, model=model, **LONG)


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    place = tmp_path_factory.mktemp("two")
    assert run_ranks(2, on_two, place) == [0, 0]
    return place


@pytest.fixture(scope="module", params=PARTS)
def alone(request, tmp_path_factory):
    place = tmp_path_factory.mktemp("alone") / request.param
    return learn(place, model=PARTS[request.param], **LONG)


@pytest.mark.parametrize("runner", ["DDPTrainRunner", "FSDPTrainRunner"])
def test_two_processes_train_as_one_does(two, alone, runner):
    assert_trained_alike(two / f"{alone.name}-{runner}", alone)


@pytest.mark.parametrize("part", PARTS)
def test_a_process_holds_what_a_dry_run_says(tmp_path, part):
    config = config_of("FSDPTrainRunner", 4, PARTS[part])
    assert run_ranks(2, check_held, tmp_path, config, Samples(), 4) == [0, 0]


def test_in_bf16_the_losses_are_about_the_same(two, tmp_path):
    alone = losses(learn(tmp_path, model=PARTS["language"]))
    found = losses(two / "bf16")
    assert found != alone
    np.testing.assert_allclose(found, alone, rtol=0.02)


def test_a_training_resumes_bit_for_bit(tmp_path):
    model = {"train_expert_only": False, "freeze_vision_encoder": False}
    settings = {"save_iter_interval": 2, "max_keep_ckpts": 0, "ema_decay": 0.9}
    whole = learn(tmp_path / "whole", model=model, **settings)
    first = str(folders(whole)[0])
    on = learn(tmp_path / "on", model=model, resume=first, **settings)
    assert checkpoint_differences(latest(whole).path, latest(on).path) == []


def test_blocks_are_recomputed_to_the_same_gradients(tmp_path):
    plain = learn(tmp_path / "plain", model=PARTS["language"])
    again = learn(tmp_path / "again", model=PARTS["language"], enable_gradient_checkpointing=True)
    np.testing.assert_allclose(losses(again), losses(plain), rtol=1e-6)
