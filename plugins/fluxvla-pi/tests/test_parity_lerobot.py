"""PI0 and PI0.5 against what LeRobot 0.6.1 computed (``oracles/make_lerobot061.py``)."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from fluxvla_pi.names import LEROBOT
from safetensors.torch import load_file

from .tiny import acting_batch, model_of, relative, training_batch

GOLDEN = Path(__file__).parent / "golden"


@pytest.fixture(scope="module", params=["pi0", "pi05"])
def pair(request):
    golden = load_file(GOLDEN / f"lerobot061_{request.param}.safetensors")
    return model_of(request.param, LEROBOT), golden


def test_losses(pair):
    model, golden = pair
    found = model(**training_batch())
    assert found["loss"].item() == pytest.approx(golden["losses"].mean().item(), rel=1e-5)
    assert relative(found["sample_losses"], golden["losses"].mean((1, 2))) < 1e-5


def test_only_the_robots_own_dimensions_count_if_they_are_named(pair):
    model, golden = pair
    model.ori_action_dim = 3
    try:
        found = model(**training_batch())["loss"].item()
    finally:
        model.ori_action_dim = None
    assert found == pytest.approx(golden["losses"][..., :3].mean().item(), rel=1e-5)


def test_gradients(pair):
    model, golden = pair
    model.zero_grad()
    model(**training_batch())["loss"].backward()
    named = {LEROBOT.theirs(name): p.grad for name, p in model.named_parameters()}
    compared = [name for name in golden if name.startswith("gradient.")]
    assert len(compared) > 16
    for name in compared:
        found = named["model." + name.removeprefix("gradient.")]
        assert relative(found, golden[name]) < 1e-5, name


def test_sampled_actions(pair):
    model, golden = pair
    with torch.no_grad():
        found = model.predict_action(**acting_batch())
    assert relative(found, golden["actions"]) < 1e-5
