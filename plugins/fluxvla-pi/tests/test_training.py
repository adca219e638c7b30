"""Training by every strategy: two processes equal one, and a run goes on bit for bit."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fluxvla_core.checkpoints.checkpoint import folders, latest
from fluxvla_core.testing.training import (
    assert_trained_alike,
    checkpoint_differences,
    run_ranks,
    train,
)
from tests.training.held_memory import check_held

from .oracles.pi_inputs import (
    ACTION_WORDS,
    ACTIONS,
    CAMERAS,
    FAST_SIZES,
    FAST_TOKENS,
    FAST_WORDS,
    HORIZON,
    SIZES,
    STATES,
    VISION,
    VOCABULARY,
    WORDS,
)
from .tiny import FAST

SEEN = ("images", "img_masks", "lang_tokens", "lang_masks")
FLOW = ("states", "actions", "action_masks", "noise", "time")
SAID = ("action_tokens", "action_token_masks")
LEARNED = {"pi0": FLOW, "pi05": FLOW, "pi0_fast": SAID}
MODELS = {
    "pi0_fast": {"type": "PI0FAST", **FAST_SIZES, "action_dim": ACTIONS, "tokenizer": FAST},
    "pi0": {"type": "PI0FlowMatching", **SIZES, "max_state_dim": STATES},
    "pi05": {"type": "PI05FlowMatching", **SIZES},
}


class Samples:
    """Samples that follow from their index, and noise from the epoch, too."""

    fps = 10.0

    def __len__(self):
        return 16

    def get_sample(self, index, epoch):
        rng, drawn = np.random.default_rng(index), np.random.default_rng((epoch, index))
        side = VISION["image_size"]
        words = np.arange(WORDS) < 3 + index % 4
        sample = {
            "images": rng.uniform(-1, 1, (3 * CAMERAS, side, side)),
            "states": rng.standard_normal(STATES),
            "actions": rng.standard_normal((HORIZON, ACTIONS)),
            "action_masks": np.arange(HORIZON) < 2 + index % 4,
            "noise": drawn.standard_normal((2, HORIZON, ACTIONS)),
            "time": drawn.uniform(0, 0.999, 2),
        }
        sample = {key: value.astype(np.float32) for key, value in sample.items()}
        sample["lang_tokens"] = rng.integers(0, VOCABULARY, WORDS)
        sample["lang_masks"], sample["img_masks"] = words, np.array([True, index % 3 > 0])
        said = np.arange(FAST_TOKENS) < 9 + index % 12
        sample["action_tokens"] = rng.integers(3, FAST_WORDS, FAST_TOKENS) * said
        sample["action_tokens"][0] = ACTION_WORDS["bos"]
        sample["action_token_masks"] = said
        return sample


def config_of(family, runner, batch):
    """Of a run of 20 steps."""
    learned = LEARNED[family]
    return {
        "model": MODELS[family],
        "train_dataloader": {"per_device_batch_size": batch},
        "runner": {
            "learning_rate": 1e-3,
            "weight_decay": 0.01,
            "max_grad_norm": 1.0,
            "max_steps": 20,
            "save_iter_interval": 10,
            "max_keep_ckpts": 0,
            "seed": 3,
            "enable_mixed_precision_training": False,
            "collator": {
                "type": "DictCollator",
                "keys": [*SEEN, *learned],
                "meta_keys": [key for key in (*FLOW, *SAID) if key not in learned],
            },
            **runner,
        },
    }


def learn(work_dir, family, runner, batch, resume=None):
    config = config_of(family, runner, batch)
    train({"config": config, "work_dir": work_dir, "resume": resume, "dataset": Samples()})


STRATEGIES = {
    "ddp": {"type": "DDPTrainRunner"},
    "fsdp": {"type": "FSDPTrainRunner", "sharding_strategy": "full-shard"},
    "recomputed": {
        "type": "FSDPTrainRunner",
        "sharding_strategy": "full-shard",
        "enable_gradient_checkpointing": True,
    },
}


def every_strategy(root):
    torch.distributed.init_process_group("gloo")
    for family in MODELS:
        for name, runner in STRATEGIES.items():
            learn(root / family / name, family, runner, 4)
        middle = str(folders(root / family / "fsdp")[0])
        learn(root / family / "goes_on", family, STRATEGIES["fsdp"], 4, middle)


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    root = tmp_path_factory.mktemp("two")
    assert run_ranks(2, every_strategy, root) == [0, 0]
    return root


@pytest.fixture(scope="module", params=MODELS)
def trained(two, request):
    root = two / request.param
    learn(root / "alone", request.param, {"type": "OneProcessRunner"}, 8)
    return root


@pytest.mark.parametrize("name", STRATEGIES)
def test_two_processes_train_as_one(trained, name):
    # It shifts all scores of a softmax alike: its gradient is rounding, which Adam enlarges.
    assert_trained_alike(trained / name, trained / "alone", ignored=["self_attn.k_proj.bias"])


def test_a_process_holds_what_a_dry_run_says(tmp_path):
    config = config_of("pi05", STRATEGIES["fsdp"], 4)
    assert run_ranks(2, check_held, tmp_path, config, Samples(), 4) == [0, 0]


def test_it_goes_on_bit_for_bit(trained):
    whole, on = (latest(trained / part).path for part in ("fsdp", "goes_on"))
    assert checkpoint_differences(whole, on) == []
