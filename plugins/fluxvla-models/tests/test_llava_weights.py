"""Weights of LlavaVLA's parts: from folders, under other names, and sizes without a folder."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch
import transformers
from fluxvla_models.llava_vla import LlavaVLA
from fluxvla_models.pretrained_backbones import (
    LlamaBackbone,
    PaliGemmaBackbone,
    Qwen2Backbone,
    Qwen3Backbone,
    SigLIPBackbone,
)

from fluxvla_core.errors import CheckpointError, ConfigError
from fluxvla_core.training.part_weights import load_part_weights

from .llava_parts import HEAD, folders, halves

__all__ = ["folders"]


def test_weights_come_from_the_folder_and_equal_transformers(folders) -> None:
    part = SigLIPBackbone(folders["siglip"]).eval()
    reference = transformers.SiglipVisionModel.from_pretrained(
        folders["siglip"], trust_remote_code=False
    ).eval()
    images = torch.randn(2, 3, 32, 32)
    with torch.inference_mode():
        expected = reference(pixel_values=images).last_hidden_state
        torch.testing.assert_close(part(images), expected)
    inside = SigLIPBackbone(folders["siglip_both"]).eval()
    both = transformers.SiglipModel.from_pretrained(
        folders["siglip_both"], trust_remote_code=False
    ).eval()
    with torch.inference_mode():
        expected = both.vision_model(pixel_values=images).last_hidden_state
        torch.testing.assert_close(inside(images), expected)
    for kind, name in (
        (Qwen3Backbone, "qwen3"),
        (Qwen2Backbone, "qwen2"),
        (LlamaBackbone, "llama"),
    ):
        language = kind(folders[name]).eval()
        causal = transformers.AutoModelForCausalLM.from_pretrained(
            folders[name], trust_remote_code=False
        ).eval()
        tokens = torch.randint(0, 50, (2, 5))
        with torch.inference_mode():
            found = language(language.embed(tokens), torch.ones(2, 5, dtype=torch.bool))
            expected = causal(tokens, output_hidden_states=True).hidden_states[-1]
        torch.testing.assert_close(found, expected)


def test_fewer_layers_and_new_weights(folders) -> None:
    short = Qwen3Backbone(folders["qwen3"], num_layers=1)
    assert len(short.fsdp_units()) == 1
    full = Qwen3Backbone(folders["qwen3"])
    torch.testing.assert_close(short.embed(torch.arange(5)), full.embed(torch.arange(5)))
    fresh = Qwen3Backbone(folders["qwen3"], pretrained=False)
    assert not torch.allclose(fresh.embed(torch.arange(5)), full.embed(torch.arange(5)))
    with pytest.raises(ConfigError, match="num_layers 3 is not between 1 and the model's 2"):
        Qwen3Backbone(folders["qwen3"], num_layers=3)


def test_code_that_comes_with_weights_is_not_run(folders, tmp_path: Path) -> None:
    config = json.loads((Path(folders["qwen3"]) / "config.json").read_text())
    config["auto_map"] = {"AutoModel": "evil.Model"}
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(ConfigError, match="auto_map"):
        Qwen3Backbone(str(tmp_path))


def test_missing_weights_are_not_drawn_in_silence(folders, tmp_path: Path) -> None:
    from safetensors.torch import load_file, save_file

    source = Path(folders["qwen3"])
    (tmp_path / "config.json").write_text((source / "config.json").read_text())
    with pytest.raises(ConfigError, match="its weights cannot be read"):
        Qwen3Backbone(str(tmp_path))
    tensors = load_file(source / "model.safetensors")
    gone = next(name for name in tensors if name.endswith("layers.1.mlp.up_proj.weight"))
    del tensors[gone]
    save_file(tensors, tmp_path / "model.safetensors", {"format": "pt"})
    with pytest.raises(ConfigError, match=r"not all there: layers\.1\.mlp\.up_proj\.weight"):
        Qwen3Backbone(str(tmp_path))


def test_weights_of_other_sizes_are_listed(folders: dict[str, str], tmp_path: Path) -> None:
    folder = tmp_path / "wider"
    shutil.copytree(folders["qwen3"], folder)
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**config, "intermediate_size": 32}))
    words = r"mlp\.down_proj\.weight \(16, 24\), by config\.json \(16, 32\)"
    with pytest.raises(ConfigError, match=words) as error:
        Qwen3Backbone(str(folder))
    assert error.value.where == str(folder)


def new(folders: dict[str, str], **more: object) -> LlavaVLA:
    """The halves with weights drawn anew."""
    return LlavaVLA(
        vision_backbone={
            "type": "SigLIPBackbone",
            "model_folder": folders["siglip"],
            "num_cameras": 2,
            "pretrained": False,
        },
        projector={"type": "FusedMLPProjector"},
        llm_backbone={
            "type": "Qwen3Backbone",
            "model_folder": folders["qwen3"],
            "pretrained": False,
        },
        vla_head=HEAD,
        **more,
    )


def test_weights_come_under_other_names(folders: dict[str, str]) -> None:
    """The language model alone, from its own folder, which has a layer for words besides."""
    mapping = {"llm_backbone.model.": "model."}
    place = {"pretrained_name_or_path": folders["qwen3"], "name_mapping": mapping}
    model = new(folders, **place, strict_mapping=False)
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    load_part_weights(model, model.part_weights)
    theirs = halves(folders).llm_backbone.state_dict()
    for name, tensor in model.state_dict().items():
        part, _, rest = name.partition(".")
        expected = theirs[rest] if part == "llm_backbone" else before[name]
        assert torch.equal(tensor, expected), name
    assert model.pretrained_name_or_path is None
    strict = new(folders, **place)
    with pytest.raises(CheckpointError, match=r"1 left over: lm_head\.weight"):
        load_part_weights(strict, strict.part_weights)
    wrong = new(folders, **{**place, "name_mapping": {"llm_backbone.": "model."}})
    with pytest.raises(CheckpointError, match=r"missing: model\.model\.embed_tokens\.weight"):
        load_part_weights(wrong, wrong.part_weights)


def test_names_of_no_place_are_refused(folders: dict[str, str]) -> None:
    for more in (
        {"name_mapping": {"llm_backbone.": ""}},
        {"name_mapping": {}, "pretrained_name_or_path": folders["qwen3"]},
    ):
        with pytest.raises(ConfigError, match="name_mapping says how weights are called in"):
            new(folders, **more)


BACKBONES = {
    "siglip": SigLIPBackbone,
    "siglip_both": SigLIPBackbone,
    "qwen3": Qwen3Backbone,
    "qwen2": Qwen2Backbone,
    "llama": LlamaBackbone,
    "paligemma": PaliGemmaBackbone,
}


@pytest.mark.parametrize("name", BACKBONES)
def test_sizes_make_the_same_part_without_its_folder(folders: dict[str, str], name: str) -> None:
    """From what a checkpoint stores: JSON."""
    part = BACKBONES[name](folders[name])
    sizes = json.loads(json.dumps(part.sizes))
    again = BACKBONES[name]("nowhere", pretrained=False, sizes=sizes)
    again.load_state_dict(part.state_dict())  # strict
    assert again.sizes == part.sizes
    assert again.out_dim == part.out_dim
    theirs, ours = (p.model.config.to_dict() for p in (part, again))
    differ = {key for key in theirs if theirs[key] != ours.get(key)}
    assert differ <= {"architectures", "_name_or_path", "dtype", "vision_config", "text_config"}
    BACKBONES[name](folders[name], sizes=sizes)  # and equal those in the folder


def test_a_folder_may_be_absent_where_its_weights_are_not_needed(folders: dict[str, str]) -> None:
    sizes = Qwen3Backbone(folders["qwen3"]).sizes
    with torch.device("meta"):
        assert len(Qwen3Backbone("nowhere", sizes=sizes).fsdp_units()) == 2
    # A training would start from weights that are drawn anew, and nobody would notice.
    with pytest.raises(ConfigError, match="'nowhere' does not exist"):
        Qwen3Backbone("nowhere", sizes=sizes)
    with pytest.raises(ConfigError, match="'nowhere' does not exist") as error:
        Qwen3Backbone("nowhere")
    assert "sizes=dict(...)" in str(error.value.next)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"hidden_size": 24}, r"sizes\.hidden_size is 24, config\.json has 16"),
        ({"hidden": 24}, r"sizes\.hidden: a qwen3 has no such setting"),
        ({"auto_map": {"AutoModel": "evil.Model"}}, r"sizes\.auto_map: a qwen3 has no such"),
        ({"attn_implementation": "some/kernel"}, r"sizes\.attn_implementation: a qwen3 has no"),
        ({"model_type": "qwen2"}, "sizes.model_type is 'qwen2'; qwen3 is expected"),
    ],
)
def test_sizes_that_are_wrong(folders: dict[str, str], change: dict, words: str) -> None:
    sizes = {**Qwen3Backbone(folders["qwen3"]).sizes, **change}
    places = ["nowhere"] if "hidden_size" not in change else [folders["qwen3"]]
    for place in {*places, folders["qwen3"]}:
        with pytest.raises(ConfigError, match=words):
            Qwen3Backbone(place, pretrained=False, sizes=sizes)


def test_a_checkpoint_s_table_has_the_sizes_of_its_parts(folders: dict[str, str]) -> None:
    table = {"type": "LlavaVLA", "projector": {"type": "FusedMLPProjector"}}
    parts = {
        "vision_backbone": {"type": "SigLIPBackbone", "model_folder": folders["siglip"]},
        "llm_backbone": {"type": "Qwen3Backbone", "model_folder": folders["qwen3"]},
    }
    stored = halves(folders).checkpoint_table({**table, **parts, "vla_head": HEAD})
    assert stored["llm_backbone"] == {
        **parts["llm_backbone"],
        "sizes": Qwen3Backbone(folders["qwen3"]).sizes,
    }
    assert stored["vision_backbone"]["sizes"]["patch_size"] == 16
    assert stored["projector"] == table["projector"]
    assert stored["vla_head"] == HEAD
