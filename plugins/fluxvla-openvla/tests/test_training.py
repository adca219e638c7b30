"""Training by every strategy, gone on with after a stop, and with adapters on published weights."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fluxvla_openvla.openvla import OpenVLA
from safetensors.torch import load_file

from fluxvla_core.checkpoints.checkpoint import latest
from fluxvla_core.cli.main import main
from fluxvla_core.data import sample_rng
from fluxvla_core.testing.training import assert_trained_alike, run_ranks
from fluxvla_core.testing.training import train as train_tiny

from . import published, tiny

HORIZON = {"OpenVLA": 1, "OpenVLAOFT": 2}
LORA = {
    "rank": 4,
    "alpha": 2,
    "target_modules": (
        r"vision_backbone\.(fused_)?featurizer\.blocks\.[01]\.(attn\.(qkv|proj)|mlp\.fc[12])"
        r"|projector\.fc[123]"
        r"|language_model\.model\.layers\.\d+\.(self_attn\.[qkvo]_proj|mlp\.(gate|up|down)_proj)"
    ),
    "modules_to_save": ["action_head", "proprio_projector"],
}

# By plain gradient descent: AdamW divides gradients of rounding errors by their own size.
PLAIN = {
    "optimizer": {"type": "SGD"},
    "learning_rate": 0.05,
    "max_grad_norm": None,
    "max_steps": 20,
    "save_iter_interval": 10,
    "max_keep_ckpts": 0,
}


class Samples:
    """``length`` samples whose noise follows from (seed, epoch, index)."""

    fps = 10.0
    statistics = {"private": published.entry()}  # noqa: RUF012
    embodiment = None

    def __init__(self, kind: str, head: str = "l1") -> None:
        self.kind, self.head = kind, head

    def __len__(self):
        return 12

    def get_sample(self, index, epoch):
        fixed = np.random.default_rng(index)
        horizon = HORIZON[self.kind]
        length = 4 + index % 3
        tokens = np.zeros(7, np.int64)
        tokens[:length] = [1, *fixed.integers(3, 300, length - 1)]
        sample = {
            "images": fixed.uniform(-1, 1, (3 * horizon, 28, 28)).astype(np.float32),
            "lang_tokens": tokens,
            "lang_masks": tokens != 0,
            "actions": fixed.uniform(-1, 1, (horizon, 7)).astype(np.float32),
            "sample_ids": np.int64(index),
        }
        if self.kind == "OpenVLAOFT":
            sample["states"] = fixed.uniform(-1, 1, 8).astype(np.float32)
        if self.head == "diffusion":
            rng = sample_rng(3, epoch, index)
            sample["noise"] = rng.standard_normal((1, horizon, 7)).astype(np.float32)
            sample["time"] = rng.integers(0, 50, 1)
        return sample


def train(work_dir, runner, kind="OpenVLA", batch=4, head="l1", model=None, resume=None):
    samples = Samples(kind, head)
    keys = list(samples.get_sample(0, 0))
    table = {"type": kind, **(model or tiny.SMALL)}
    if kind == "OpenVLAOFT":
        table |= {"horizon": 2, "head": head}
    settings = {
        "learning_rate": 2e-3,
        "max_steps": 4,
        "seed": 5,
        "collator": {"type": "DictCollator", "keys": keys},
        **runner,
    }
    config = {
        "model": table,
        "train_dataloader": {"per_device_batch_size": batch},
        "runner": settings,
    }
    run = {"config": config, "work_dir": work_dir, "resume": resume, "dataset": samples}
    return train_tiny(run)


def weights(work_dir):
    return latest(work_dir).tensors("model.safetensors")


def sharded(work_dir):
    torch.distributed.init_process_group("gloo")
    for kind in HORIZON:
        for name, runner in (("fsdp", "FSDPTrainRunner"), ("ddp", "DDPTrainRunner")):
            table = {"type": runner, **PLAIN}
            train(work_dir / name / kind, table, kind, batch=2)


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    work_dir = tmp_path_factory.mktemp("two")
    assert run_ranks(2, sharded, work_dir) == [0, 0]
    return work_dir


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    work_dir = tmp_path_factory.mktemp("alone")
    for kind in HORIZON:
        train(work_dir / kind, {"type": "DDPTrainRunner", **PLAIN}, kind, batch=4)
    return work_dir


@pytest.mark.parametrize("strategy", ["fsdp", "ddp"])
@pytest.mark.parametrize("kind", list(HORIZON))
def test_two_processes_train_as_one(two, alone, strategy, kind):
    assert_trained_alike(two / strategy / kind, alone / kind)


@pytest.mark.parametrize(("kind", "head"), [("OpenVLA", "l1"), ("OpenVLAOFT", "diffusion")])
def test_a_run_that_was_stopped_goes_on_bit_for_bit(tmp_path, kind, head):
    runner = {"type": "DDPTrainRunner", "save_iter_interval": 2, "max_keep_ckpts": 0}
    train(tmp_path / "whole", runner, kind, head=head)
    train(tmp_path / "cut", {**runner, "max_steps": 2}, kind, head=head)
    train(tmp_path / "cut", runner, kind, head=head, resume="auto")
    whole, cut = weights(tmp_path / "whole"), weights(tmp_path / "cut")
    assert all(torch.equal(whole[name], cut[name]) for name in whole)


def adapters(work_dir, start):
    table = {"type": "DDPTrainRunner", "init_from": str(start), "lora": LORA, "max_steps": 3}
    model = {**tiny.SIZES, "num_images": 2}
    train(work_dir, table, "OpenVLAOFT", batch=2, model=model)


def test_adapters_on_published_weights(tmp_path, capsys):
    published.openvla(tmp_path / "openvla")
    words = ("openvla-oft", tmp_path / "openvla", tmp_path / "start", "--horizon", "2")
    assert main([str(word) for word in words]) == 0
    adapters(tmp_path / "run", tmp_path / "start")
    saved = load_file(latest(tmp_path / "run").path / "adapter" / "adapter_model.safetensors")
    layers = {name.partition(".lora_")[0] for name in saved if ".lora_" in name}
    # Four layers of two blocks of two towers, three of the projector, seven of two layers.
    assert len(layers) == 4 * 2 * 2 + 3 + 7 * 2
    assert any("action_head" in name for name in saved)
    assert main(["export", str(tmp_path / "run"), str(tmp_path / "merged")]) == 0
    merged = load_file(tmp_path / "merged" / "model.safetensors")
    base = OpenVLA(**tiny.SIZES).state_dict()
    assert base.keys() <= merged.keys()
    capsys.readouterr()


def test_the_adapters_of_the_papers_recipe_have_the_published_number_of_parameters():
    with torch.device("meta"):
        model = OpenVLA()
    # "all-linear" of that peft went by the ends of names: it took the convolutions that cut
    # patches too, which are called proj like a layer, and lm_head.
    total = 0
    for module in model.modules():
        if isinstance(module, torch.nn.Linear):
            total += 32 * (module.in_features + module.out_features)
        elif isinstance(module, torch.nn.Conv2d):
            total += 32 * (module.weight[0].numel() + module.out_channels)
    # As the authors' fine-tuning prints it.
    assert total == 110_828_288
