"""Acting fast: the same numbers however it is executed, and steps that could be captured."""

from __future__ import annotations

import pytest
import torch
from fluxvla_models.velocity import sample

from fluxvla_core.testing import ExecutionConformance

from .tiny import acting_batch, model_of, relative

FAMILIES = ("pi0", "pi05")


def shaken(family):
    """A model none of whose weights are zeros, as adaptive normalisation's are at the beginning."""
    model = model_of(family)
    torch.manual_seed(0)
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    return model


class TestPI0(ExecutionConformance):
    def model(self):
        return shaken("pi0")

    def batches(self):
        batch = acting_batch()
        return [{key: value[row : row + 1] for key, value in batch.items()} for row in range(3)]


class TestPI05(TestPI0):
    def model(self):
        return shaken("pi05")


@pytest.mark.parametrize("family", FAMILIES)
def test_the_steps_with_tables_are_those_of_any_time(family):
    """Against the velocity that training has, at the times of the steps."""
    model, batch = shaken(family), acting_batch()
    with torch.no_grad():
        found = model.predict_action(**batch)
        prefix = model.embed_prefix(
            batch["images"], batch["img_masks"], batch["lang_tokens"], batch["lang_masks"]
        )
        known = model._keys_and_values(prefix)

        def velocity(x, tau):
            return model._velocity(x, tau, batch["states"], prefix.real, known)

        expected = sample(velocity, batch["noise"], model.num_steps)
    assert relative(found, expected) < 1e-5
