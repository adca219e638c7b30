"""Names of published tensors against those of the models here, at full size and without memory."""

from __future__ import annotations

import json

import pytest
import torch
from fluxvla_openvla.names import (
    film_name,
    flatten_native,
    merge_lora,
    native_name,
    part_name,
    published_film_name,
    with_lora,
)
from fluxvla_openvla.openvla import OpenVLA
from fluxvla_openvla.openvla_oft import OpenVLAOFT

from fluxvla_core.errors import CheckpointError

from . import tiny

KEYS = tiny.HERE / "keys"


@pytest.fixture(scope="module")
def openvla():
    with torch.device("meta"):
        return OpenVLA()


def shapes(model):
    return {name: list(tensor.shape) for name, tensor in model.state_dict().items()}


def test_openvla_has_the_published_tensors_and_parameters(openvla):
    assert shapes(openvla) == json.loads((KEYS / "openvla-7b.json").read_text())
    # The number that the authors' fine-tuning prints, without its LoRA matrices.
    assert sum(p.numel() for p in openvla.parameters()) == 7_541_237_184


def test_oft_adds_the_published_head_and_projector(openvla):
    with torch.device("meta"):
        found = shapes(OpenVLAOFT())
    parts = json.loads((KEYS / "openvla-oft-libero.json").read_text())
    added = {part_name(p, f"module.{n}"): s for p, names in parts.items() for n, s in names.items()}
    assert found == {**shapes(openvla), **added}


def test_native_names_cover_the_same(openvla):
    """The native layout, by the rules of the authors' converter, read backwards."""
    rules = (
        ("vision_backbone.featurizer.", "vision_backbone.dino_featurizer."),
        ("vision_backbone.fused_featurizer.", "vision_backbone.siglip_featurizer."),
        ("projector.fc1.", "projector.projector.0."),
        ("projector.fc2.", "projector.projector.2."),
        ("projector.fc3.", "projector.projector.4."),
        ("language_model.", "llm_backbone.llm."),
    )
    for name in shapes(openvla):
        native = next(b + name.removeprefix(a) for a, b in rules if name.startswith(a))
        native = native.replace(".scale_factor", ".gamma")
        assert native != name
        assert native_name(native) == name


def test_film_names_go_both_ways():
    with torch.device("meta"):
        model = OpenVLAOFT(**tiny.SMALL, use_film=True)
    names = [name for name in model.state_dict() if name.startswith("vision_backbone.")]
    assert sum(".scale." in name for name in names) == 12
    for name in names:
        assert film_name(published_film_name(name)) == name
    assert published_film_name("vision_backbone.featurizer.blocks.3.attn.qkv.bias") == (
        "vision_backbone.featurizer.blocks.3.block.attn.qkv.bias"
    )


def test_lora_matrices_are_added_as_the_authors_do():
    torch.manual_seed(0)
    base, down, up = torch.randn(6, 4), torch.randn(32, 4), torch.randn(6, 32)
    tensors = {
        "a.base_layer.weight": base,
        "a.base_layer.bias": torch.ones(6),
        "a.lora_A.default.weight": down,
        "a.lora_B.default.weight": up,
        "b.weight": torch.ones(2),
    }
    found = merge_lora(tensors, "file")
    assert found.keys() == {"a.weight", "a.bias", "b.weight"}
    torch.testing.assert_close(found["a.weight"], base + 0.5 * up @ down)
    folded = torch.nn.functional.conv2d
    conv, down, up = torch.randn(5, 3, 2, 2), torch.randn(8, 3, 2, 2), torch.randn(5, 8, 1, 1)
    names = ("c.base_layer.weight", "c.lora_A.default.weight", "c.lora_B.default.weight")
    found = merge_lora(dict(zip(names, (conv, down, up), strict=True)), "file")
    image = torch.randn(1, 3, 4, 4)
    expected = folded(image, conv, stride=2) + 1.0 * folded(folded(image, down, stride=2), up)
    torch.testing.assert_close(folded(image, found["c.weight"], stride=2), expected)
    del tensors["a.lora_B.default.weight"]
    with pytest.raises(CheckpointError, match="LoRA matrices of 'a' are not complete"):
        merge_lora(tensors, "file")


def test_films_file_is_written_under_the_authors_names():
    expected = json.loads((KEYS / "openvla-oft-film-tiny.json").read_text())
    model = OpenVLAOFT(**tiny.SMALL, use_film=True)
    state = {n: t for n, t in model.state_dict().items() if n.startswith("vision_backbone.")}
    written = with_lora({published_film_name(n): t for n, t in state.items()})
    assert {name: list(tensor.shape) for name, tensor in written.items()} == expected
    back = merge_lora({film_name(n): t for n, t in written.items()}, "file")
    assert back.keys() == state.keys()
    assert all(torch.equal(back[name], state[name]) for name in state)


def test_a_native_file_of_something_else():
    with pytest.raises(CheckpointError, match=r"projector\.x is not a tensor"):
        flatten_native({"projector": {"x": 3}}, "file")
    with pytest.raises(CheckpointError, match="'epoch' is not a table"):
        flatten_native({"epoch": 3}, "file")
