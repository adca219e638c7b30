"""Norms in a model whose other weights are gathered in bf16."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from fluxvla_core import VLAS
from fluxvla_core.checkpoints.checkpoint import folders, latest
from fluxvla_core.testing.training import (
    STATES,
    TinyVLA,
    checkpoint_differences,
    run_ranks,
    tiny_config,
    train,
)

NORMS = {
    "batch": nn.BatchNorm1d,
    # It takes a batch of two vectors for two channels.
    "instance": lambda size: nn.InstanceNorm1d(2, affine=True, track_running_stats=True),
    "layer": nn.LayerNorm,
    "group": lambda size: nn.GroupNorm(2, size),
}
SEEN = {}


@VLAS.register_module()
class NormedVLA(TinyVLA):
    """A TinyVLA that normalises its inputs, which are fp32, and in a block what a linear layer
    made, which is bf16."""

    def __init__(self, norm):
        super().__init__(dropout=0.0)
        self.norm = norm
        self.first = NORMS[norm](STATES)
        self.blocks[0].norm = NORMS[norm](8)
        # Of this unit only a norm is trained.
        self.blocks[1].requires_grad_(False)
        self.blocks[1].norm = NORMS[norm](8).requires_grad_(True)

    def forward(self, states, **batch):
        hook = self.blocks[0].norm.register_forward_pre_hook(self._look)
        found = super().forward(states=self.first(states), **batch)
        hook.remove()
        return found

    def _look(self, module, args):
        SEEN[self.norm] = module.weight.dtype


def every_norm(work_dir):
    torch.distributed.init_process_group("gloo")
    for norm in NORMS:
        table = {
            "type": "FSDPTrainRunner",
            "max_steps": 4,
            "save_iter_interval": 2,
            "enable_mixed_precision_training": True,
        }
        config = {**tiny_config(table, batch=2), "model": {"type": "NormedVLA", "norm": norm}}
        whole, on = (work_dir / f"{norm}-{part}" for part in ("whole", "on"))
        train({"config": config, "work_dir": str(whole)})
        train({"config": config, "work_dir": str(on), "resume": str(folders(whole)[0])})
    assert dict.fromkeys(NORMS, torch.float32) == SEEN


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    work_dir = tmp_path_factory.mktemp("norms")
    assert run_ranks(2, every_norm, work_dir) == [0, 0]
    return work_dir


@pytest.mark.parametrize("norm", NORMS)
def test_a_norm_trains_in_bf16_and_goes_on_bit_for_bit(trained, norm):
    whole, on = (latest(trained / f"{norm}-{part}") for part in ("whole", "on"))
    assert checkpoint_differences(whole.path, on.path) == []
    weights = whole.tensors("model.safetensors")
    for name in ("first.weight", "blocks.1.norm.weight"):
        assert not torch.equal(weights[name], torch.ones_like(weights[name]))
