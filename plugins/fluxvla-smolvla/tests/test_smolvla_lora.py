"""The adapters of the shipped config: they train, and act merged as they do apart."""

from __future__ import annotations

import pytest
import torch

from fluxvla_core.training.lora import attach, merge_
from tests.training.adapters import OWN, adapted, idle_parameters, shipped

from .tiny import model_batch, tiny_model

pytest.importorskip("peft")
CONFIG = "smolvla_libero_lora.py"


def test_every_adapter_trains():
    assert idle_parameters(tiny_model(), shipped(CONFIG), model_batch()) == []


def test_the_models_own_layers_are_those_of_the_config():
    assert adapted(tiny_model(), OWN) == adapted(tiny_model(), shipped(CONFIG))


def test_the_adapter_of_the_last_layer_has_an_effect_and_merges():
    model = tiny_model()
    with torch.no_grad():
        bare = model(**model_batch())["loss"]
        attach(model, shipped(CONFIG))
        torch.manual_seed(1)
        for name, parameter in model.named_parameters():
            if name.startswith("action_out_proj.lora_B"):
                parameter.normal_()
        apart = model(**model_batch())["loss"]
        merge_(model)
        merged = model(**model_batch())["loss"]
    assert abs(apart - bare) > 1e-3 * bare
    torch.testing.assert_close(merged, apart, rtol=1e-5, atol=0)
