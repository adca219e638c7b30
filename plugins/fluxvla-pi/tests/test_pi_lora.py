"""The adapters of the shipped configs: every one of them trains."""

from __future__ import annotations

import pytest
import torch

from tests.training.adapters import OWN, adapted, idle_parameters, shipped

from .oracles.pi_inputs import EXPERT, GEMMA
from .tiny import fast_batch, fast_model, model_of, training_batch

pytest.importorskip("peft")
DEPTH = 18  # PaliGemma's: the configs' regular expressions name its last layer
DEEP = {"variant": {**GEMMA, "depth": DEPTH}, "expert_variant": {**EXPERT, "depth": DEPTH}}


@pytest.mark.parametrize(
    ("family", "config"), [("pi0", "pi0_libero_lora.py"), ("pi05", "pi05_aloha_lora.py")]
)
def test_every_adapter_of_a_flow_matching_config_trains(family, config):
    model = model_of(family, **DEEP)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            # PI0.5's gates begin at zero, and what is behind a closed gate gets no gradient yet.
            if name.endswith(("dense.weight", "dense.bias")):
                parameter.normal_(std=0.5)
    assert idle_parameters(model, shipped(config), training_batch()) == []
    own = adapted(model_of(family, **DEEP), OWN)
    assert own == {name for name, p in model.named_parameters() if p.requires_grad}


def test_every_adapter_of_pi0_fasts_config_trains():
    model = fast_model(variant={**GEMMA, "depth": DEPTH})
    assert idle_parameters(model, shipped("pi0_fast_libero_lora.py"), fast_batch()) == []
    own = adapted(fast_model(variant={**GEMMA, "depth": DEPTH}), OWN)
    assert own == {name for name, p in model.named_parameters() if p.requires_grad}
