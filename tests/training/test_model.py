"""What of a batch reaches the model."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from fluxvla_core.data.loader import to_device
from fluxvla_core.errors import ConfigError
from fluxvla_core.training.model import ForwardArguments, checkpoint_activations, loss_of


class Model(nn.Module):
    def forward(self, states, actions, masks=None):
        return {"loss": states.sum()}


class Greedy(nn.Module):
    def forward(self, **batch):
        return {"loss": torch.zeros(())}


X = torch.ones(2)


def test_lists_and_sample_ids_that_the_model_does_not_take_are_left_out():
    """Field notes 4.1: collators list keys that describe; they go no further."""
    batch = {"states": X, "actions": X, "sample_ids": X, "prompt": ["a", "b"]}
    assert set(ForwardArguments(Model())(batch)) == {"states", "actions"}


def test_a_model_that_takes_everything_gets_everything():
    assert set(ForwardArguments(Greedy())({"a": X, "b": [1]})) == {"a", "b"}


def test_a_tensor_that_the_model_does_not_take_is_refused():
    with pytest.raises(ConfigError) as caught:
        ForwardArguments(Model(), "c.py:7: runner.collator")({"states": X, "actions": X, "mask": X})
    assert str(caught.value) == (
        "c.py:7: runner.collator: Model.forward takes no 'mask'; it takes actions, masks, states\n"
        "  next: move what only describes from the collator's keys to meta_keys"
    )


def test_a_tensor_that_the_model_needs_and_does_not_get_is_refused():
    with pytest.raises(ConfigError) as caught:
        ForwardArguments(Model())({"states": X, "prompt": []})
    assert str(caught.value) == (
        "Model.forward needs 'actions', which the batch does not have; it has prompt, states\n"
        "  next: let a transform of the dataset make it, and list it in the collator's keys"
    )


@pytest.mark.parametrize("output", [None, {}, {"loss": 1.0}, {"loss": torch.zeros(2)}])
def test_a_model_without_a_scalar_loss_is_refused(output):
    with pytest.raises(ConfigError, match=r"Model\.forward must return a mapping with a scalar"):
        loss_of(output, "Model")


def test_to_device_leaves_lists_alone():
    assert to_device({"a": X, "b": ["t"]}, torch.device("meta"))["a"].device.type == "meta"
    assert to_device({"b": ["t"]}, torch.device("cpu")) == {"b": ["t"]}


class Units(nn.Module):
    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.a = nn.Sequential(nn.Linear(4, 4), nn.Dropout(0.5), nn.ReLU())
        self.b = nn.Linear(4, 1)
        self.runs = 0
        self.a.register_forward_hook(lambda *_: None)
        self.a[0].register_forward_hook(self.count)

    def count(self, *_):
        self.runs += 1

    def fsdp_units(self):
        return [self.a]

    def forward(self, x):
        return self.b(self.a(x)).sum()


def test_recomputing_changes_no_gradient_and_no_name():
    """T13 of upstream's bugs: activation checkpointing assumed attribute names."""
    grads = []
    for recompute in (False, True):
        net = Units()
        if recompute:
            checkpoint_activations(net)
        torch.manual_seed(1)
        net(torch.ones(3, 4)).backward()
        grads.append([p.grad for p in net.parameters()])
        assert net.runs == (2 if recompute else 1)
    assert all(map(torch.equal, *grads))
    assert set(net.state_dict()) == set(Units().state_dict())


def test_a_model_without_units_cannot_recompute():
    with pytest.raises(ConfigError, match="Model names no units to recompute"):
        checkpoint_activations(Model())
