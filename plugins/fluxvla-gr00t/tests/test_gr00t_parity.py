"""The models give what LeRobot's do with the same weights and inputs (tests/oracles/make_*.py)."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from fluxvla_gr00t.names import key_map
from safetensors.torch import load_file

from tests.oracles import fill

from .gr00t_sizes import PLACE, tiny

GOLDEN = Path(__file__).parent / "golden"
FILES = {"n1.5": "lerobot044_n15", "n1.7": "lerobot061_n17"}
SIDES = {"n1.5": 28, "n1.7": 16}


def batch(version, padded=False, masked=False):
    """The oracles' inputs: two samples of two images; ``padded``: the second has fewer words."""
    side = SIDES[version]
    words = torch.from_numpy(fill.integers("words", (2, 7), PLACE))
    places = torch.full((2, 4), PLACE)
    tokens = torch.cat([words[:, :4], places, words[:, 4:5], places, words[:, 5:]], dim=1)
    seen = torch.ones(2, 15, dtype=torch.bool)
    action_masks = torch.ones(2, 6)
    if padded:
        seen[1, :3] = False
    if masked:
        action_masks[0, 4:] = 0
    return {
        "images": torch.from_numpy(fill.normal("pictures", (2, 6, side, side))),
        "lang_tokens": tokens,
        "lang_masks": seen,
        "states": torch.from_numpy(fill.normal("states", (2, 7))),
        "actions": torch.from_numpy(fill.normal("actions", (2, 6, 5))),
        "action_masks": action_masks,
        "noise": torch.from_numpy(fill.normal("noise", (2, 6, 5)))[:, None],
        "time": torch.from_numpy(fill.uniform("time", (2,)))[:, None],
        "embodiment_ids": torch.tensor([2, 0]),
    }


def to_act(inputs):
    wanted = ("images", "lang_tokens", "lang_masks", "states", "embodiment_ids")
    return {**{key: inputs[key] for key in wanted}, "noise": inputs["noise"][:, 0]}


def golden(version, case):
    file = load_file(GOLDEN / f"{FILES[version]}.safetensors")
    return {k.removeprefix(f"{case}."): v for k, v in file.items() if k.startswith(f"{case}.")}


def assert_equal(found, expected, what):
    # 1e-5 of the largest: single elements of a gradient may be sums that nearly cancel.
    error = (found - expected).abs().max() / expected.abs().max()
    assert error < 1e-5, f"{what}: {error:.2e}"


def computed(version, padded, dtype):
    """The model and its results by the golden file's names, all but the gradients."""
    # The last dimension of actions is padding; padded, it is as the reference trains.
    model = tiny(version, ori_action_dim=4, attend_padding=padded, mean_over_valid=padded)
    model.to(dtype)
    inputs = {
        name: value.to(dtype) if value.is_floating_point() else value
        for name, value in batch(version, padded, masked=padded).items()
    }
    loss = model(**inputs)["loss"]
    loss.backward()
    with torch.no_grad():
        seen = model.vlm_backbone(
            inputs["images"], inputs["lang_tokens"], inputs["lang_masks"], None
        )
        actions = model.predict_action(**to_act(inputs))
    return model, {"loss": loss.detach(), "features": seen.features, "actions": actions}


@pytest.mark.parametrize("case", ["even", "padded"])
@pytest.mark.parametrize("version", ["n1.5", "n1.7"])
def test_loss_gradients_and_actions_are_the_reference_s(version, case):
    # The file was computed in float64, and so is this: in float32 two processors differ by up to
    # 1e-5 of a gradient.
    known = golden(version, case)
    model, found = computed(version, case == "padded", torch.float64)
    for name, tensor in found.items():
        assert_equal(tensor, known.pop(name), name)
    parameters = dict(model.named_parameters())
    own = key_map(parameters, version)
    assert len(known) == 12
    for name, gradient in known.items():
        tensor = parameters[own[name.removeprefix("gradient.")]].grad
        assert_equal(tensor, gradient, name)


@pytest.mark.parametrize("case", ["even", "padded"])
@pytest.mark.parametrize("version", ["n1.5", "n1.7"])
def test_loss_and_actions_in_float32_are_the_reference_s(version, case):
    known = golden(version, case)
    for name, tensor in computed(version, case == "padded", torch.float32)[1].items():
        assert_equal(tensor, known[name], name)


@pytest.mark.parametrize("case", ["even", "padded"])
@pytest.mark.parametrize("version", ["n1.5", "n1.7"])
def test_in_bf16_it_differs_no_more_than_the_reference(version, case):
    exact, lower = golden(version, case), golden(version, f"bf16.{case}")
    with torch.autocast("cpu", torch.bfloat16):
        _, found = computed(version, case == "padded", torch.float32)
    assert set(found) == set(lower)
    for name, tensor in found.items():
        for expected in (exact[name], lower[name]):
            error = (tensor.float() - expected).abs().max() / expected.abs().max()
            assert error < 5e-2, f"{name}: {error:.2e}"
