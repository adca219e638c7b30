"""The models equal the authors' own code, run by ``oracles/make_openvla.py`` in float32."""

from __future__ import annotations

import pytest
import torch

from . import tiny

OFT = ("oft", "film", "diffusion")
RELATIVE = 1e-5
NARROW = 5e-2
"""Of the largest number, in bfloat16."""


def check(found: torch.Tensor, expected, share: float = RELATIVE) -> None:
    """Equal to ``share`` of the largest number."""
    expected = torch.from_numpy(expected)
    assert found.shape == expected.shape
    assert (found.float() - expected).abs().max() <= share * expected.abs().max()


def check_gradients(model, golden, name_of=str) -> None:
    parameters = {name_of(name): p for name, p in model.named_parameters()}
    seen = 0
    for key, expected in golden.items():
        if key.startswith("gradient "):
            check(parameters[key.removeprefix("gradient ")].grad, expected)
            seen += 1
    assert seen >= 4


def test_openvla_learns_as_the_authors_code():
    golden, model = tiny.golden("openvla"), tiny.openvla()
    loss = model(**tiny.batch(1, 1))["loss"]
    check(loss.detach()[None], golden["loss"])
    loss.backward()
    check_gradients(model, golden)


def test_openvla_acts_as_the_authors_code():
    golden, model = tiny.golden("openvla"), tiny.openvla()
    batch = tiny.batch(1, 1)
    del batch["actions"]
    with torch.no_grad():
        check(model.vision_backbone(batch["images"]), golden["features"])
        check(model.predict_action(**batch)[:, 0], golden["predicted"])


@pytest.mark.parametrize("name", OFT)
def test_oft_learns_as_the_authors_code(name):
    golden, model = tiny.golden(name), tiny.oft(name)
    found = model(**tiny.oft_batch(name))
    check(found["sample_losses"], golden["losses"])
    check(found["loss"].detach()[None], golden["loss"])
    found["loss"].backward()
    # With FiLM the oracle's gradients are named as in the file of the vision backbone.
    check_gradients(model, golden, tiny.film_file_name if name == "film" else str)


@pytest.mark.parametrize("name", OFT)
def test_oft_acts_as_the_authors_code(name):
    # In float64: the steps of a sampler add up what processors differ by in float32.
    golden, model = tiny.golden(name), tiny.oft(name).double()
    batch = {k: v.double() if v.is_floating_point() else v for k, v in tiny.oft_batch(name).items()}
    noise = batch.pop("noise", None)
    asked = {k: v for k, v in batch.items() if k not in ("actions", "time")}
    if noise is not None:
        asked["noise"] = noise[:, 0]
    with torch.no_grad():
        check(model.predict_action(**asked), golden["predicted"])
        if name == "diffusion":
            model.num_inference_steps = 10
            check(model.predict_action(**asked), golden["predicted in 10 steps"])


def test_in_bf16_openvla_differs_no_more_than_the_authors_code():
    golden, model = tiny.golden("openvla"), tiny.openvla()
    batch = tiny.batch(1, 1)
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        loss, features = model(**batch)["loss"], model.vision_backbone(batch["images"])
    for kind in ("", "bf16."):
        check(loss[None], golden[f"{kind}loss"], NARROW)
        check(features, golden[f"{kind}features"], NARROW)


def test_in_bf16_oft_differs_no_more_than_the_authors_code():
    golden, model = tiny.golden("oft"), tiny.oft("oft")
    batch = tiny.oft_batch("oft")
    asked = {name: value for name, value in batch.items() if name != "actions"}
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        found, predicted = model(**batch), model.predict_action(**asked)
    for kind in ("", "bf16."):
        check(found["loss"][None], golden[f"{kind}loss"], NARROW)
        check(found["sample_losses"], golden[f"{kind}losses"], NARROW)
        check(predicted, golden[f"{kind}predicted"], NARROW)
