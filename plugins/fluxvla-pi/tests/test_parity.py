"""PI0 and PI0.5 against what LeRobot 0.6.1 and openpi computed (``oracles/make_*.py``)."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from fluxvla_pi.names import LEROBOT, OPENPI
from safetensors.torch import load_file

from .tiny import acting_batch, model_of, relative, training_batch

GOLDEN = Path(__file__).parent / "golden"


# The names of LeRobot's weights begin with "model." in its checkpoints, and not in its model.
REFERENCES = {"lerobot061": (LEROBOT, "model."), "openpi": (OPENPI, "")}


@pytest.fixture(scope="module", params=["pi0", "pi05"])
def family(request):
    return request.param


@pytest.fixture(scope="module", params=REFERENCES)
def pair(request, family):
    """Our model, what the reference computed, and the name of each of our weights there."""
    layout, beginning = REFERENCES[request.param]
    golden = load_file(GOLDEN / f"{request.param}_{family}.safetensors")
    model = model_of(family, layout)
    names = {name: layout.theirs(name) for name, _ in model.named_parameters()}
    return model, golden, {name: given.removeprefix(beginning) for name, given in names.items()}


def test_losses(pair):
    model, golden, _ = pair
    found = model(**training_batch())
    assert found["loss"].item() == pytest.approx(golden["losses"].mean().item(), rel=1e-5)
    assert relative(found["sample_losses"], golden["losses"].mean((1, 2))) < 1e-5


def test_only_the_robots_own_dimensions_count_if_they_are_named(pair):
    model, golden, _ = pair
    model.ori_action_dim = 3
    try:
        found = model(**training_batch())["loss"].item()
    finally:
        model.ori_action_dim = None
    assert found == pytest.approx(golden["losses"][..., :3].mean().item(), rel=1e-5)


def test_gradients(pair):
    model, golden, names = pair
    model.zero_grad()
    model(**training_batch())["loss"].backward()
    named = {names[name]: p.grad for name, p in model.named_parameters()}
    compared = [name for name in golden if name.startswith("gradient.")]
    assert len(compared) > 12
    for name in compared:
        found = named[name.removeprefix("gradient.")]
        assert relative(found, golden[name]) < 1e-5, name


def test_sampled_actions(pair):
    model, golden, _ = pair
    # Ten steps by LeRobot; openpi's ten times are rounded otherwise (``make_openpi.py``).
    steps, key = (10, "actions") if "actions" in golden else (8, "actions.8")
    before, model.num_steps = model.num_steps, steps
    try:
        with torch.no_grad():
            found = model.predict_action(**acting_batch())
    finally:
        model.num_steps = before
    assert relative(found, golden[key]) < 1e-5
    if key != "actions":
        with torch.no_grad():
            found = model.predict_action(**acting_batch())
        assert relative(found, golden["actions.10"]) < 5e-5
