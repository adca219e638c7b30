"""Parameter groups, gradient clipping, and optimizer state by name."""

from __future__ import annotations

import copy
import json

import pytest
import torch
from torch import nn

from fluxvla_core.errors import CheckpointError, ConfigError
from fluxvla_core.training.model import clip_, decay_groups
from fluxvla_core.training.optimizers import AdamW
from fluxvla_core.training.state import named_state, torch_state


def model():
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(3, 4), nn.LayerNorm(4), nn.Linear(4, 2))


def make_adamw(net, learning_rate, weight_decay):
    return AdamW().build(decay_groups(net, weight_decay), learning_rate)


def trained(net, steps=3):
    optimizer = make_adamw(net, 1e-2, 0.1)
    for _ in range(steps):
        net(torch.ones(2, 3)).square().sum().backward()
        optimizer.step()
        optimizer.zero_grad()
    return optimizer


def test_vectors_and_biases_get_no_decay():
    net = model()
    decayed, rest = decay_groups(net, 0.1)
    assert [p.shape for p in decayed["params"]] == [(4, 3), (2, 4)]
    assert decayed["weight_decay"] == 0.1
    assert [p.shape for p in rest["params"]] == [(4,), (4,), (4,), (2,)]
    assert rest["weight_decay"] == 0.0


def test_a_two_dimensional_bias_gets_no_decay():
    class Odd(nn.Module):
        def __init__(self):
            super().__init__()
            self.bias = nn.Parameter(torch.zeros(2, 2))

    (group,) = decay_groups(Odd(), 0.1)
    assert group["weight_decay"] == 0.0


def test_frozen_parameters_are_in_no_group():
    net = model()
    net[0].requires_grad_(False)
    assert sum(len(g["params"]) for g in decay_groups(net, 0.1)) == 4


def test_a_model_without_anything_to_train_is_refused():
    with pytest.raises(ConfigError, match="no trainable parameter"):
        decay_groups(model().requires_grad_(False), 0.0)


def test_master_weights_move_by_small_steps():
    """T6 of upstream's bugs: at 1.0, under steps of 5e-5, a bf16 weight would stand still."""
    net = nn.Linear(1, 1, bias=False)
    nn.init.ones_(net.weight)
    optimizer = make_adamw(net, 5e-5, 0.0)
    for _ in range(100):
        net.weight.grad = torch.ones_like(net.weight)
        optimizer.step()
    assert net.weight.item() == pytest.approx(1 - 100 * 5e-5, abs=1e-5)


def test_named_state_and_back_is_the_same_bit_for_bit():
    net = model()
    optimizer = trained(net)
    tensors, described = named_state(net, optimizer)
    assert {"0.weight/exp_avg", "0.weight/exp_avg_sq", "0.weight/step"} <= set(tensors)
    described = json.loads(json.dumps(described))
    other = copy.deepcopy(net)
    fresh = make_adamw(other, 1e-2, 0.1)
    fresh.load_state_dict(torch_state(other, fresh, tensors, described, "here"))
    for parameter, twin in zip(net.parameters(), other.parameters(), strict=True):
        for key, value in optimizer.state[parameter].items():
            assert torch.equal(value, fresh.state[twin][key]), key
    for network, stepper in ((net, optimizer), (other, fresh)):
        network(torch.ones(2, 3)).square().sum().backward()
        stepper.step()
    assert all(map(torch.equal, net.parameters(), other.parameters()))


def test_hyperparameters_are_the_configs_and_the_rate_is_the_checkpoints():
    net = model()
    optimizer = trained(net)
    optimizer.param_groups[0]["lr"] = 0.5
    tensors, described = named_state(net, optimizer)
    fresh = make_adamw(net, 1e-2, 0.7)
    groups = torch_state(net, fresh, tensors, described, "here")["param_groups"]
    assert groups[0]["lr"] == 0.5
    assert groups[0]["weight_decay"] == 0.7


def test_scalars_that_are_no_tensors_are_kept():
    net = model()
    optimizer = torch.optim.SGD(net.parameters(), lr=0.1, momentum=0.9)
    net(torch.ones(2, 3)).sum().backward()
    optimizer.step()
    optimizer.state[net[0].weight]["hits"] = 3
    tensors, described = named_state(net, optimizer)
    assert described["scalars"] == {"0.weight/hits": 3}
    state = torch_state(net, optimizer, tensors, described, "here")["state"]
    assert state[0]["hits"] == 3


def test_another_optimizer_or_other_groups_are_refused():
    net = model()
    tensors, described = named_state(net, trained(net))
    sgd = torch.optim.SGD(net.parameters(), lr=0.1)
    with pytest.raises(CheckpointError, match=r"\(AdamW, groups of \[2, 4\] parameters\) is not"):
        torch_state(net, sgd, tensors, described, "here")
    net[2].requires_grad_(False)
    with pytest.raises(CheckpointError, match=r"\(AdamW, \[1, 3\]\)"):
        torch_state(net, make_adamw(net, 0.1, 0.1), tensors, described, "here")


@pytest.mark.parametrize("max_norm", [0.1, 1e9])
def test_clipping_is_torchs(max_norm):
    grads = []
    for clip in (clip_, nn.utils.clip_grad_norm_):
        net = model()
        net(torch.ones(2, 3)).square().sum().backward()
        net[0].bias.grad = None
        norm = clip(list(net.parameters()), max_norm)
        grads.append([norm, *(p.grad for p in net.parameters() if p.grad is not None)])
    assert all(map(torch.equal, *grads))
