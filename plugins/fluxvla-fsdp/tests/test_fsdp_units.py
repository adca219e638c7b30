"""Two towers whose layers are used together: one unit per pair, and the same training."""

from __future__ import annotations

import json

import pytest
import torch
from torch import nn

from fluxvla_core import VLAS
from fluxvla_core.checkpoints.checkpoint import latest
from fluxvla_core.testing.training import (
    ACTIONS,
    HORIZON,
    STATES,
    OneProcessRunner,
    run_ranks,
    tiny_config,
    train,
)

WIDTH = 8


class Layer(nn.Module):
    """Attention over own tokens, and over another tower's keys and values if they are given."""

    def __init__(self):
        super().__init__()
        self.qkv = nn.Linear(WIDTH, 3 * WIDTH)
        self.out = nn.Linear(WIDTH, WIDTH)

    def forward(self, x, seen=None):
        query, key, value = self.qkv(x).chunk(3, -1)
        if seen is not None:
            key, value = torch.cat([seen[0], key], 1), torch.cat([seen[1], value], 1)
        attended = nn.functional.scaled_dot_product_attention(query, key, value)
        return x + self.out(attended), (key, value)


@VLAS.register_module()
class TwoTowerVLA(nn.Module):
    """A mixture of transformers: layer ``i`` of the expert attends to layer ``i`` of the first.

    Args:
        frozen: do not train the first tower.
        pairs: name pairs as units; else every layer is one.
    """

    def __init__(self, frozen=False, pairs=True):
        super().__init__()
        self.see = nn.Linear(STATES, WIDTH)
        self.act = nn.Linear(ACTIONS, WIDTH)
        self.vlm = nn.ModuleList(Layer() for _ in range(2))
        self.expert = nn.ModuleList(Layer() for _ in range(2))
        self.head = nn.Linear(WIDTH, ACTIONS)
        self.pairs = pairs
        self.vlm.requires_grad_(not frozen)

    def forward(self, states, actions, noise):
        seen, x = self.see(states).unsqueeze(1), self.act(noise)
        for vlm, expert in zip(self.vlm, self.expert, strict=True):
            seen, known = vlm(seen)
            x, _ = expert(x, known)
        return {"loss": (self.head(x) - actions).square().mean()}

    @property
    def action_shape(self):
        return HORIZON, ACTIONS

    def fsdp_units(self):
        pairs = list(zip(self.vlm, self.expert, strict=True))
        return pairs if self.pairs else [layer for pair in pairs for layer in pair]


def config(kind, batch, **model):
    table = {"type": kind, "max_steps": 4, "max_grad_norm": 0.5}
    return {**tiny_config(table, batch), "model": {"type": "TwoTowerVLA", **model}}


def groups_of(model):
    """For every layer: its group of parameters that is gathered at once, as parameter names."""
    names = {id(p): n for n, p in model.named_parameters()}
    found = {}
    for kind in ("vlm", "expert"):
        for i, layer in enumerate(getattr(model, kind)):
            group = layer._get_fsdp_state()._fsdp_param_group if hasattr(layer, "unshard") else None
            params = [] if group is None else group.fsdp_params
            found[f"{kind}.{i}"] = sorted(names[id(p.sharded_param)] for p in params)
    return found


def both(work_dir):
    torch.distributed.init_process_group("gloo")
    for name, settings in {"pairs": {}, "frozen": {"frozen": True}}.items():
        run = {"config": config("FSDPTrainRunner", 2, **settings), "work_dir": work_dir / name}
        model = train(run).model
        if torch.distributed.get_rank() == 1:
            (work_dir / f"{name}.json").write_text(json.dumps(groups_of(model)))


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    work_dir = tmp_path_factory.mktemp("towers")
    assert run_ranks(2, both, work_dir) == [0, 0]
    return work_dir


def test_layers_of_a_pair_are_gathered_together(trained):
    found = json.loads((trained / "pairs.json").read_text())
    for i in range(2):
        parts = [f"{n}.{p}" for n in ("out", "qkv") for p in ("bias", "weight")]
        expected = sorted(f"{kind}.{i}.{part}" for kind in ("vlm", "expert") for part in parts)
        assert found[f"vlm.{i}"] == found[f"expert.{i}"] == expected


def test_of_a_pair_that_is_half_frozen_only_the_other_half_is_split(trained):
    found = json.loads((trained / "frozen.json").read_text())
    assert found["vlm.0"] == []
    assert {name.split(".")[0] for name in found["expert.0"]} == {"expert"}


@pytest.mark.parametrize("name", ["pairs", "frozen"])
def test_two_towers_train_as_in_one_process(trained, tmp_path, name):
    alone = config(OneProcessRunner.__name__, 4, frozen=name == "frozen")
    train({"config": alone, "work_dir": tmp_path})
    ours, theirs = (latest(d).tensors("model.safetensors") for d in (trained / name, tmp_path))
    assert ours.keys() == theirs.keys()
    assert max(float((ours[n] - theirs[n]).abs().max()) for n in ours) < 1e-5
