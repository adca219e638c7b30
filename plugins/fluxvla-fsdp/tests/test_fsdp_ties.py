"""Weights that stand in two places: refused where torch cannot split them, trained elsewhere."""

from __future__ import annotations

import pytest
import torch
from fluxvla_fsdp.groups import check_ties
from torch import nn

from fluxvla_core import VLAS
from fluxvla_core.checkpoints.checkpoint import latest
from fluxvla_core.errors import ConfigError
from fluxvla_core.testing.training import Block, TinyVLA, run_ranks, tiny_config, train

WIDTH = 8


@VLAS.register_module()
class TiedVLA(TinyVLA):
    """A TinyVLA in which two places are one.

    Args:
        tie: which places share a weight.
    """

    def __init__(self, tie, **settings):
        super().__init__(WIDTH, **settings)
        first, second = self.blocks
        plain = [nn.Linear(WIDTH, WIDTH, bias=False) for _ in range(2)]
        self.together = None
        if tie in ("two units", "a tuple", "frozen"):
            second.linear.weight = first.linear.weight
            first.linear.weight.requires_grad_(tie != "frozen")
            self.together = second if tie == "a tuple" else None
        elif tie in ("a unit and the rest", "a tuple with the rest"):
            plain[0].weight = first.linear.weight
            self.head = nn.Sequential(plain[0], self.head)
            self.together = plain[0] if tie == "a tuple with the rest" else None
        elif tie == "a module in two places":
            self.head = nn.Sequential(first.linear, self.head)
        elif tie == "the rest":
            plain[1].weight = plain[0].weight
            self.head = nn.Sequential(*plain, self.head)
        elif tie == "one unit":
            other = Block(WIDTH, 0.0)
            other.linear.weight = first.linear.weight
            self.blocks[0] = nn.Sequential(first, other)

    def fsdp_units(self):
        if self.together is None:
            return list(self.blocks)
        alone = [block for block in self.blocks if block is not self.together]
        return [(alone[0], self.together), *alone[1:]]


REFUSED = {
    "two units": ("blocks.0.linear.weight and blocks.1.linear.weight", "in unit 0 and in unit 1"),
    "a unit and the rest": (
        "blocks.0.linear.weight and head.0.weight",
        "in unit 0 and outside all units",
    ),
    "a module in two places": (
        "blocks.0.linear.weight and head.0.weight",
        "in unit 0 and outside all units",
    ),
}
TRAINED = ("one unit", "the rest", "a tuple", "a tuple with the rest", "frozen")


@pytest.mark.parametrize("tie", REFUSED)
def test_a_weight_in_two_units_is_refused_by_both_its_names(tie):
    names, places = REFUSED[tie]
    with pytest.raises(ConfigError) as caught:
        check_ties(TiedVLA(tie), "config.py:3: model")
    assert caught.value.what == f"{names} are one weight ({places} of TiedVLA)"
    assert caught.value.where == "config.py:3: model"
    assert "gathers and lets go of each unit's weights on their own" in str(caught.value)
    assert "into one tuple of fsdp_units()" in str(caught.value)


def config(kind, tie, batch=2):
    tree = tiny_config({"type": kind, "max_steps": 4}, batch)
    return {**tree, "model": {"type": "TiedVLA", "tie": tie, "dropout": 0.0}}


def refused(work_dir):
    for tie in REFUSED:
        with pytest.raises(ConfigError, match="are one weight"):
            train({"config": config("FSDPTrainRunner", tie), "work_dir": work_dir / tie})


def test_the_runner_refuses_it(tmp_path):
    assert run_ranks(1, refused, tmp_path) == [0]


def every_tie(work_dir):
    torch.distributed.init_process_group("gloo")
    for tie in TRAINED:
        train({"config": config("FSDPTrainRunner", tie), "work_dir": work_dir / tie})


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    work_dir = tmp_path_factory.mktemp("ties")
    assert run_ranks(2, every_tie, work_dir) == [0, 0]
    return work_dir


@pytest.mark.parametrize("tie", TRAINED)
def test_other_ties_train_as_in_one_process(trained, tmp_path, tie):
    train({"config": config("OneProcessRunner", tie, 4), "work_dir": tmp_path})
    ours, theirs = (latest(d).tensors("model.safetensors") for d in (trained / tie, tmp_path))
    assert ours.keys() == theirs.keys()
    assert max(float((ours[n] - theirs[n]).abs().max()) for n in ours) < 1e-5
