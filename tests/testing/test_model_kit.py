"""The kit of models: a right one passes, and each wrong one fails its own check in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
from torch import nn

from fluxvla_core.testing.model import ModelConformance, Sizes

from .specimens import Fault, Outcomes, check_fault, check_good, outcomes

GOOD = """
import numpy as np
import torch
from torch import nn
from fluxvla_core import VLA, VLAS
from fluxvla_core.models import InputSizes
from fluxvla_core.testing import ModelConformance

@VLAS.register_module()
class Specimen(VLA, nn.Module):
    api = "1.0"
    action_shape = (4, 3)
    input_sizes = InputSizes(states=5, actions=3, horizon=4)
    def __init__(self, width: int = 16):
        super().__init__()
        self.enter = nn.Linear(5, width)
        self.block = nn.Sequential(nn.Linear(width, width), nn.Tanh())
        self.head = nn.Linear(width, 12)
        self.register_buffer("scale", torch.ones(()))
        self.frozen = nn.Linear(2, 2).requires_grad_(False)
    def fsdp_units(self):
        return [self.block]
    def forward(self, states, actions, noise):
        if self.training:
            self.scale *= 0.99
        found = self.plan(states)
        return {"loss": (found - actions - 0.1 * noise.mean(1)).square().mean()}
    def plan(self, states):
        hidden = self.block(torch.tanh(self.enter(states)))
        return torch.unflatten(self.scale * self.head(hidden), 1, (4, 3))
    def predict_action(self, states, noise):
        return self.plan(states) + 0.1 * noise

class TestSpecimen(ModelConformance):
    entry_point = "Specimen"
    state_dim = 5
"""
LOSS = 'return {"loss": (found - actions - 0.1 * noise.mean(1)).square().mean()}'
PREDICT = "return self.plan(states) + 0.1 * noise"
TRAINING = (
    "forward_gives_a_loss", "every_trainable_parameter_gets_a_gradient", "it_learns_one_batch",
    "random_numbers_are_those_of_the_checkpoint", "the_batch_belongs_to_the_caller",
    "what_it_learns_is_in_its_state_dict", "it_trains_in_bf16", "its_fsdp_units_are_called",
)  # fmt: skip
ACTING = (
    "predicted_chunks_have_their_shape", "an_answer_can_be_repeated",
    "rows_do_not_depend_on_each_other", "the_observation_belongs_to_the_caller",
)  # fmt: skip
GRADIENTS = (
    "every_trainable_parameter_gets_a_gradient", "it_learns_one_batch",
    "the_batch_belongs_to_the_caller", "what_it_learns_is_in_its_state_dict", "it_trains_in_bf16",
)  # fmt: skip
FAULTS = {
    "another declared width": Fault(
        "the_sizes_that_it_declares_are_those_that_it_takes", "states=5", "states=6",
        "the width of states is 6, in the data it is 5",
    ),
    "another declared chunk": Fault(
        "the_sizes_that_it_declares_are_those_that_it_takes", "horizon=4", "horizon=3",
        "the number of actions in a chunk is 3, in the data it is 4",
    ),
    "no version": Fault("is_complete", '    api = "1.0"\n', "", "the version of the contract"),
    "another key": Fault(
        "forward_gives_a_loss", LOSS, LOSS.replace('"loss"', '"cost"'),
        "gave a dict of cost, expected a mapping with 'loss'", TRAINING[1:],
    ),
    "a loss for each": Fault(
        "forward_gives_a_loss", LOSS, LOSS.replace(".mean()", ".mean((1, 2))"),
        "gave a loss of shape (2,), expected one number", TRAINING[1:],
    ),
    "a loss of nothing": Fault(
        "forward_gives_a_loss", LOSS, LOSS.replace("(found - ", "(found.detach() - "),
        "depends on no trainable parameter", GRADIENTS,
    ),
    "not finite": Fault(
        "forward_gives_a_loss", LOSS, LOSS.replace(".mean()}", ".mean() / 0.0}"),
        "gave the loss inf, expected a finite one",
        ("it_learns_one_batch", "what_it_learns_is_in_its_state_dict", "it_trains_in_bf16"),
    ),
    "another width": Fault(
        "forward_gives_a_loss", "nn.Linear(5, width)", "nn.Linear(6, width)",
        "it was given states (2, 5) float32, actions (2, 4, 3) float32, "
        "noise (2, 2, 4, 3) float32: set state_dim, cameras", (*TRAINING[1:], *ACTING),
    ),
    "asks for more": Fault(
        "forward_gives_a_loss", "def forward(self, states, actions, noise)",
        "def forward(self, states, actions, noise, depth)", "needs depth", TRAINING[1:],
    ),
    "an idle layer": Fault(
        "every_trainable_parameter_gets_a_gradient", ".requires_grad_(False)", "",
        "frozen.weight, frozen.bias have no gradient",
    ),
    "learns nothing": Fault(
        "it_learns_one_batch", "found = self.plan(states)",
        "found = self.plan(states); found = found - found.detach() + 1e-9 * found",
        "took the loss from",
    ),
    "its own generator": Fault(
        "random_numbers_are_those_of_the_checkpoint", "found = self.plan(states)",
        "found = self.plan(states) + 0.1 * float(np.random.default_rng().normal())",
        "a generator of its own is in no checkpoint",
        ("what_it_learns_is_in_its_state_dict",),
    ),
    "writes into the batch": Fault(
        "the_batch_belongs_to_the_caller", "found = self.plan(states)",
        "actions += 0.01; found = self.plan(states)", "changed actions of the batch",
        ("random_numbers_are_those_of_the_checkpoint", "what_it_learns_is_in_its_state_dict"),
    ),
    "keeps what it learns": Fault(
        "what_it_learns_is_in_its_state_dict", 'self.register_buffer("scale", torch.ones(()))',
        "self.scale = torch.ones(())", "register_buffer keeps it",
    ),
    "overflows": Fault(
        "it_trains_in_bf16", "found = self.plan(states)",
        "found = self.plan(states)\n"
        "        if torch.is_autocast_enabled('cpu'): found = found * 1e30",
        "in bf16 forward() gave the loss inf",
    ),
    "a unit of another": Fault(
        "its_fsdp_units_are_called", "return [self.block]", "return [nn.Linear(1, 1)]",
        "are no modules of the model",
    ),
    "a unit passed by": Fault(
        "its_fsdp_units_are_called", "hidden = self.block(torch", "hidden = self.block[0](torch",
        "never called block",
    ),
    "another shape": Fault(
        "predicted_chunks_have_their_shape", PREDICT, "return (self.plan(states) + noise).mean(1)",
        "expected (2, 4, 3)",
    ),
    "an array": Fault(
        "predicted_chunks_have_their_shape", PREDICT, PREDICT[:7] + f"({PREDICT[7:]}).numpy()",
        "gave a ndarray, expected a tensor", ACTING[1:],
    ),
    "acts on actions": Fault(
        "predicted_chunks_have_their_shape", "def predict_action(self, states, noise)",
        "def predict_action(self, states, noise, actions)", "a robot has no actions", ACTING[1:],
    ),
    "draws itself": Fault(
        "an_answer_can_be_repeated", PREDICT, "return self.plan(states) + torch.randn_like(noise)",
        "take the argument noise",
        ("rows_do_not_depend_on_each_other",),
    ),
    "mixes rows": Fault(
        "rows_do_not_depend_on_each_other", PREDICT, PREDICT + " - self.plan(states).mean(0)",
        "asks for several episodes at once",
    ),
    "writes into the observation": Fault(
        "the_observation_belongs_to_the_caller", PREDICT, f"states *= 0.5; {PREDICT}",
        "changed states of its arguments",
        ("an_answer_can_be_repeated", "rows_do_not_depend_on_each_other"),
    ),
}  # fmt: skip


class Sized(nn.Module):
    def __init__(
        self,
        max_state_dim: int = 14,
        num_cameras: int = 3,
        image_size: tuple[int, int] = (48, 64),
        vocab_size: int = 50,
    ) -> None:
        super().__init__()


class Nested(nn.Module):
    def __init__(self, vision: Mapping[str, Any], state_dim: int = 9) -> None:
        super().__init__()


@pytest.mark.parametrize(
    ("model", "settings", "sizes"),
    [
        (Sized, {}, Sizes(14, 3, (48, 64), 8, 50)),
        (Sized, {"arguments": {"vocab_size": 20}, "words": 5}, Sizes(14, 3, (48, 64), 5, 20)),
        (Sized, {"state_dim": 2, "picture": (8, 4)}, Sizes(2, 3, (8, 4), 8, 50)),
        (Nested, {"arguments": {"vision": {"image_size": 16}}}, Sizes(9, 2, (16, 16), 8, 100)),
    ],
)
def test_a_batch_has_the_sizes_of_the_constructor(
    model: type, settings: dict[str, Any], sizes: Sizes
) -> None:
    kit = type("Kit", (ModelConformance,), {"component": lambda self: model, **settings})
    assert kit().sizes() == sizes


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Outcomes:
    return outcomes(tmp_path_factory.mktemp("models"), GOOD, FAULTS)


def test_a_right_model_passes_every_check(found: Outcomes) -> None:
    check_good(found, checks=15)


@pytest.mark.parametrize("name", FAULTS)
def test_a_wrong_model_fails_its_own_check(found: Outcomes, name: str) -> None:
    check_fault(found, name, FAULTS[name])
