"""Two processes train each model as one does, and a run that is resumed gives the same."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
import transformers

from fluxvla_core import EmbodimentSpec, Joint
from fluxvla_core.checkpoints.checkpoint import folders
from fluxvla_core.testing.training import (
    OneProcessRunner,
    assert_trained_alike,
    differences,
    run_ranks,
    train,
)
from tests.training.held_memory import check_held

JOINTS, HORIZON = 3, 4
SEEN = {"state_dim": JOINTS, "action_dim": JOINTS, "horizon": HORIZON, "num_cameras": 2}
TABLES: dict[str, dict[str, Any]] = {
    "act": {
        "type": "ACT",
        **SEEN,
        "backbone_norm": "group",
        "backbone_width": 8,
        "dim_model": 16,
        "n_heads": 2,
        "dim_feedforward": 24,
        "n_encoder_layers": 1,
        "n_vae_encoder_layers": 1,
        "latent_dim": 4,
        "dropout": 0.0,
    },
    "diffusion": {
        "type": "DiffusionPolicy",
        **SEEN,
        "backbone_width": 8,
        "keypoints": 4,
        "crop_shape": (28, 28),
        "down_dims": (8, 16),
        "diffusion_step_embed_dim": 8,
        "num_train_timesteps": 20,
    },
}
TABLES["compact"] = {
    "type": "CompactVLA",
    "vision_backbone": {
        "type": "ConvEncoder",
        "image_size": (32, 32),
        "channels": (8, 8, 16),
        "num_cameras": 2,
    },
    "llm_backbone": {"type": "SentenceEncoder"},
    "projector": {"type": "FiLMProjector", "width": 16},
    "vla_head": {"type": "FlowMatchingHead", "horizon": HORIZON, "action_dim": 3, "width": 16},
    "state_dim": JOINTS,
}
TABLES["diffusion_of_two"] = {**TABLES["diffusion"], "n_obs_steps": 2}
KEYS = {
    "act": ("latent_noise",),
    "diffusion": ("noise", "timesteps", "crops"),
    "diffusion_of_two": ("noise", "timesteps", "crops"),
    "llava": ("lang_tokens", "lang_masks", "img_masks"),
    "compact": ("lang_tokens", "lang_masks", "noise", "time"),
}
ALWAYS = ("images", "states", "actions", "action_masks", "sample_ids")


DOUBLE = ("diffusion", "diffusion_of_two")
"""Compared in float64. In float32 rounding errors of 1e-7 grow to 1e-2 within 20 steps, also on one
process that adds up its gradients in another order; in float64 those of 1e-16 stay below 1e-8."""


class Samples:
    """A dozen samples that follow from their index, with what a model takes."""

    fps = 10.0
    statistics: ClassVar[dict[str, Any]] = {
        "private": {"action": {"mean": [0.0] * JOINTS, "std": [1.0] * JOINTS}}
    }
    embodiment = EmbodimentSpec(
        "tiny", tuple(Joint(f"j{i}", "rad", -1.0, 1.0, 1.0, 1.0) for i in range(JOINTS)), (), 10.0
    )

    def __init__(self, name: str, dtype: str = "float32") -> None:
        self.dtype = dtype
        self.keys = {*ALWAYS, *KEYS[name]}
        self.n_obs_steps = 2 if name.endswith("of_two") else 1
        self.past_actions = self.n_obs_steps - 1

    def __len__(self) -> int:
        return 12

    def get_sample(self, index: int, epoch: int) -> dict[str, Any]:
        rng = np.random.default_rng(index)
        masks = np.ones(HORIZON, np.float32)
        masks[HORIZON - index % 3 :] = 0
        words = np.arange(5) < 3 + index % 3
        steps = () if self.n_obs_steps == 1 else (self.n_obs_steps,)
        sample = {
            "images": rng.standard_normal((*steps, 6, 32, 32)).astype(np.float32),
            "states": rng.standard_normal((*steps, JOINTS)).astype(np.float32),
            "actions": rng.standard_normal((HORIZON, JOINTS)).astype(np.float32),
            "action_masks": masks,
            "latent_noise": rng.standard_normal(4).astype(np.float32),
            "noise": rng.standard_normal((2, HORIZON, JOINTS)).astype(np.float32),
            "time": rng.random(2).astype(np.float32),
            "timesteps": rng.integers(0, 20, 2),
            "crops": rng.random(2).astype(np.float32),
            "lang_tokens": rng.integers(1, 40, 5),
            "lang_masks": words,
            "img_masks": np.ones(2, np.bool_),
            "sample_ids": np.int64(index),
        }
        return {
            key: value.astype(self.dtype) if value.dtype == np.float32 else value
            for key, value in sample.items()
            if key in self.keys
        }


def config_of(
    name: str, table: dict[str, Any], runner: str, batch: int, **more: Any
) -> dict[str, Any]:
    """Of a training of 20 steps."""
    return {
        "model": table,
        "train_dataloader": {"per_device_batch_size": batch},
        "runner": {
            "type": runner,
            "max_steps": 20,
            "save_iter_interval": 10,
            "max_keep_ckpts": 0,
            # AdamW would make steps of gradients that are nothing but rounding errors: a bias
            # before a normalisation, a bias of keys.
            "optimizer": {"type": "SGD"},
            "learning_rate": 0.01,
            "max_grad_norm": 1.0,
            "enable_mixed_precision_training": False,
            "collator": {"type": "DictCollator", "keys": [*ALWAYS, *KEYS[name]]},
            **more,
        },
    }


def run(
    name: str,
    table: dict[str, Any],
    runner: str,
    batch: int,
    work_dir: Path,
    dtype: str = "float32",
    **more: Any,
) -> None:
    resume = more.pop("resume", None)
    config = config_of(name, table, runner, batch, **more)
    settings = {"config": config, "work_dir": work_dir, "resume": resume}
    before = torch.get_default_dtype()
    torch.set_default_dtype(getattr(torch, dtype))
    try:
        train({**settings, "dataset": Samples(name, dtype)})
    finally:
        torch.set_default_dtype(before)


def compared(name: str, *where: Any) -> None:
    """A run of those whose losses and weights are compared."""
    run(name, *where, dtype="float64" if name in DOUBLE else "float32")


def two(tables: dict[str, dict[str, Any]], root: Path) -> None:
    """Every model under both strategies, in one group."""
    torch.distributed.init_process_group("gloo")
    for name, table in tables.items():
        for runner in ("DDPTrainRunner", "FSDPTrainRunner"):
            compared(name, table, runner, 2, root / f"{name}-{runner}")


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    root = tmp_path_factory.mktemp("parts")
    sizes = {
        "hidden_size": 8,
        "intermediate_size": 12,
        "num_hidden_layers": 1,
        "num_attention_heads": 2,
    }
    text = {"num_key_value_heads": 1, "head_dim": 4, "vocab_size": 40}
    torch.manual_seed(0)
    transformers.SiglipVisionModel(
        transformers.SiglipVisionConfig(**sizes, image_size=32, patch_size=16)
    ).save_pretrained(root / "siglip")
    transformers.Qwen3Model(transformers.Qwen3Config(**sizes, **text)).save_pretrained(
        root / "qwen3"
    )
    llava = {
        "type": "LlavaVLA",
        "vision_backbone": {
            "type": "SigLIPBackbone",
            "model_folder": str(root / "siglip"),
            "num_cameras": 2,
        },
        "projector": {"type": "LinearProjector"},
        "llm_backbone": {"type": "Qwen3Backbone", "model_folder": str(root / "qwen3")},
        "vla_head": {
            "type": "LlavaActionHead",
            "horizon": HORIZON,
            "action_dim": JOINTS,
            "state_dim": JOINTS,
            "width": 8,
            "num_heads": 2,
            "num_layers": 1,
        },
        "freeze_vision_backbone": True,
    }
    return {**TABLES, "llava": llava}


@pytest.fixture(scope="module")
def trained(tables, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("two")
    assert run_ranks(2, two, tables, root) == [0, 0]
    return root


@pytest.mark.parametrize("name", KEYS)
def test_two_processes_train_as_one(name: str, tables, trained: Path, tmp_path: Path) -> None:
    compared(name, tables[name], OneProcessRunner.__name__, 4, tmp_path)
    for runner in ("DDPTrainRunner", "FSDPTrainRunner"):
        assert_trained_alike(trained / f"{name}-{runner}", tmp_path)


@pytest.mark.parametrize("name", ["act", "diffusion_of_two"])
def test_a_process_holds_what_a_dry_run_says(name: str, tmp_path: Path) -> None:
    adam = {"type": "AdamW"}
    config = config_of(name, TABLES[name], "FSDPTrainRunner", 4, optimizer=adam)
    assert run_ranks(2, check_held, tmp_path, config, Samples(name), 4) == [0, 0]


@pytest.mark.parametrize("name", KEYS)
def test_a_run_that_goes_on_is_the_same_bit_for_bit(name: str, tables, tmp_path: Path) -> None:
    kept = {"max_steps": 4, "save_iter_interval": 2}
    once = OneProcessRunner.__name__
    dropout = {"dropout": 0.1} if name == "act" else {}
    table = {**tables[name], **dropout}
    run(name, table, once, 2, tmp_path / "whole", **kept)
    shutil.copytree(tmp_path / "whole", tmp_path / "parts")
    last = folders(tmp_path / "parts")[-1]
    shutil.rmtree(last)
    run(name, table, once, 2, tmp_path / "parts", **kept, resume="auto")
    assert last.is_dir()
    assert differences(tmp_path / "whole", tmp_path / "parts") == []
