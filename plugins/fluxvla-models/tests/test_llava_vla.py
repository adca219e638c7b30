"""LlavaVLA of tiny pretrained parts: it trains, acts, and neither padding nor company matters."""

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
from tokenizers import Tokenizer
from tokenizers.models import WordLevel
from tokenizers.pre_tokenizers import Whitespace

from fluxvla_core.errors import CheckpointError, ConfigError
from fluxvla_core.spec import Camera, EmbodimentSpec, Joint
from fluxvla_core.training.weights import put_parts
from tests.policies.benched import WHOLE, stages_measured

TEXT = {
    "hidden_size": 16,
    "intermediate_size": 24,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "num_key_value_heads": 1,
    "head_dim": 8,
    "vocab_size": 50,
    "max_position_embeddings": 128,
}
VISION = {
    "hidden_size": 12,
    "intermediate_size": 20,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "image_size": 32,
    "patch_size": 16,
}
HEAD = {
    "type": "LlavaActionHead",
    "horizon": 4,
    "action_dim": 3,
    "state_dim": 5,
    "width": 16,
    "num_heads": 2,
    "num_layers": 1,
}


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Folders as transformers saves them: configuration and weights."""
    root = tmp_path_factory.mktemp("parts")
    torch.manual_seed(0)
    paligemma = transformers.PaliGemmaConfig(
        text_config={**TEXT, "model_type": "gemma"},
        vision_config={**VISION, "vision_use_head": False},
        image_token_index=49,
        projection_dim=16,
    )
    models = {
        "siglip": transformers.SiglipVisionModel(transformers.SiglipVisionConfig(**VISION)),
        "siglip_both": transformers.SiglipModel(
            transformers.SiglipConfig(vision_config=VISION, text_config={**VISION, "vocab_size": 9})
        ),
        "qwen3": transformers.Qwen3ForCausalLM(transformers.Qwen3Config(**TEXT)),
        "qwen2": transformers.Qwen2ForCausalLM(transformers.Qwen2Config(**TEXT)),
        "llama": transformers.LlamaForCausalLM(transformers.LlamaConfig(**TEXT)),
        "paligemma": transformers.PaliGemmaForConditionalGeneration(paligemma),
    }
    for name, model in models.items():
        model.save_pretrained(root / name)
    return {name: str(root / name) for name in models}


def halves(folders: dict[str, str], **more: object) -> LlavaVLA:
    torch.manual_seed(1)
    return LlavaVLA(
        vision_backbone={
            "type": "SigLIPBackbone",
            "model_folder": folders["siglip"],
            "num_cameras": 2,
        },
        projector={"type": "FusedMLPProjector"},
        llm_backbone={"type": "Qwen3Backbone", "model_folder": folders["qwen3"]},
        vla_head=HEAD,
        **more,
    )


def whole(folders: dict[str, str], **more: object) -> LlavaVLA:
    torch.manual_seed(1)
    table = {
        "type": "PaliGemmaBackbone",
        "model_folder": folders["paligemma"],
        "num_cameras": 2,
    }
    return LlavaVLA(vlm_backbone=table, vla_head=HEAD, **more)


def batch_of(size: int = 3) -> dict[str, torch.Tensor]:
    torch.manual_seed(2)
    masks = torch.ones(size, 6, dtype=torch.bool)
    masks[0, 4:] = False
    return {
        "images": torch.randn(size, 6, 32, 32),
        "img_masks": torch.ones(size, 2, dtype=torch.bool),
        "lang_tokens": torch.randint(1, 40, (size, 6)),
        "lang_masks": masks,
        "states": torch.randn(size, 5),
        "actions": torch.randn(size, 4, 3),
        "action_masks": torch.ones(size, 4),
    }


def asked(batch: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {k: v for k, v in batch.items() if not k.startswith("action")}


@pytest.mark.parametrize("make", [halves, whole])
def test_it_learns_a_batch(folders, make) -> None:
    model = make(folders).train()
    batch = batch_of()
    optimizer = torch.optim.AdamW(model.parameters(), 5e-3)
    losses = []
    for _ in range(100):
        optimizer.zero_grad()
        loss = model(**batch)["loss"]
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.25 * losses[0]
    with torch.inference_mode():
        found = model.eval().predict_action(**asked(batch))
    assert found.shape == (3, *model.action_shape)
    assert (found - batch["actions"]).abs().mean() < 0.3


@pytest.mark.parametrize("make", [halves, whole])
def test_every_parameter_is_trained(folders, make) -> None:
    """DDP waits for each of them."""
    model = make(folders).train()
    model(**batch_of())["loss"].backward()
    assert [name for name, p in model.named_parameters() if p.grad is None] == []


@pytest.mark.parametrize("make", [halves, whole])
def test_padding_on_either_side_and_company_do_not_matter(folders, make) -> None:
    model = make(folders).eval()
    batch = asked(batch_of())
    with torch.inference_mode():
        together = model.predict_action(**batch)
        other = {**batch, "lang_tokens": batch["lang_tokens"].clone()}
        other["lang_tokens"][0, 4:] = 7
        torch.testing.assert_close(model.predict_action(**other), together)
        alone = {k: v[:1] for k, v in batch.items()}
        alone |= {"lang_tokens": batch["lang_tokens"][:1, :4], "lang_masks": torch.ones(1, 4) > 0}
        torch.testing.assert_close(model.predict_action(**alone), together[:1])
        left = {
            **alone,
            "lang_tokens": torch.cat([torch.zeros(1, 2).long(), alone["lang_tokens"]], 1),
            "lang_masks": torch.cat([torch.zeros(1, 2) > 0, alone["lang_masks"]], 1),
        }
        torch.testing.assert_close(model.predict_action(**left), together[:1])


@pytest.mark.parametrize("make", [halves, whole])
def test_what_is_seen_read_and_felt_matters_and_a_missing_camera_does_not(folders, make) -> None:
    model = make(folders).eval()
    batch = asked(batch_of())
    with torch.inference_mode():
        found = model.predict_action(**batch)
        for key in ("images", "states"):
            assert not torch.allclose(model.predict_action(**{**batch, key: -batch[key]}), found)
        tokens = (batch["lang_tokens"] + 1) % 40
        assert not torch.allclose(model.predict_action(**{**batch, "lang_tokens": tokens}), found)
        dark = {**batch, "img_masks": torch.tensor([[True, False]]).expand(3, 2)}
        without = model.predict_action(**dark)
        changed = batch["images"].clone()
        changed[:, 3:] = 0
        torch.testing.assert_close(model.predict_action(**{**dark, "images": changed}), without)


def test_images_and_words_see_each_other_in_paligemma(folders) -> None:
    part = PaliGemmaBackbone(folders["paligemma"], num_cameras=2).eval()
    batch = batch_of()
    keys = ("images", "img_masks", "lang_tokens", "lang_masks")
    with torch.inference_mode():
        first = part(*(batch[key] for key in keys))[0]
        batch["lang_tokens"] = (batch["lang_tokens"] + 1) % 40
        second = part(*(batch[key] for key in keys))[0]
    assert not torch.allclose(first[:, 0], second[:, 0])


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


def test_frozen_parts_stay_as_they_are(folders) -> None:
    model = halves(folders, freeze_vision_backbone=True, freeze_llm_backbone=True).train()
    assert not model.vision_backbone.training
    assert model.projector.training
    before = {n: p.clone() for n, p in model.named_parameters()}
    trained = [p for p in model.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(trained, 1e-2)
    model(**batch_of())["loss"].backward()
    optimizer.step()
    same = {n.partition(".")[0] for n, p in model.named_parameters() if torch.equal(p, before[n])}
    changed = {
        n.partition(".")[0] for n, p in model.named_parameters() if not torch.equal(p, before[n])
    }
    assert {"vision_backbone", "llm_backbone"} <= same
    assert changed == {"projector", "vla_head"}


def test_units_to_shard_are_disjoint(folders) -> None:
    for model in (halves(folders), whole(folders)):
        seen = [id(p) for unit in model.fsdp_units() for p in unit.parameters()]
        assert len(seen) == len(set(seen))
        assert len(model.fsdp_units()) >= 5


def test_parts_that_do_not_go_together(folders) -> None:
    vision = {"type": "SigLIPBackbone", "model_folder": folders["siglip"]}
    with pytest.raises(ConfigError, match=r"all of .* and llm_backbone; it was given vision_backb"):
        LlavaVLA(vla_head=HEAD, vision_backbone=vision)
    with pytest.raises(ConfigError, match="given vision_backbone, vlm_backbone"):
        whole(folders, vision_backbone=vision)
    with pytest.raises(ConfigError, match="freeze_projector: the model has no projector"):
        whole(folders, freeze_projector=True)
    with pytest.raises(ConfigError, match="the model is a qwen3; siglip or siglip_vision_model is"):
        SigLIPBackbone(folders["qwen3"])
    with pytest.raises(ConfigError, match=r"not exist|no folder|there is no"):
        Qwen3Backbone(folders["qwen3"] + "x")


def test_batches_that_do_not_fit(folders) -> None:
    model, batch = halves(folders), batch_of()
    with pytest.raises(ConfigError, match=r"num_cameras is 2, .* 3 image channels \(1 cameras\)"):
        model(**{**batch, "images": batch["images"][:, :3]})
    with pytest.raises(ConfigError, match="images are 32 x 16, the encoder sees 32 x 32"):
        model(**{**batch, "images": batch["images"][..., :16]})
    with pytest.raises(ConfigError, match=r"actions are \(3, 3\), the head's are \(4, 3\)"):
        model(**{**batch, "actions": batch["actions"][:, :3]})


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


def test_weights_of_other_sizes_are_told_with_both(folders: dict[str, str], tmp_path: Path) -> None:
    folder = tmp_path / "wider"
    shutil.copytree(folders["qwen3"], folder)
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**config, "intermediate_size": 32}))
    words = r"mlp\.down_proj\.weight \(16, 24\), by config\.json \(16, 32\)"
    with pytest.raises(ConfigError, match=words) as error:
        Qwen3Backbone(str(folder))
    assert error.value.where == str(folder)


@pytest.mark.parametrize("make", [halves, whole])
def test_in_mixed_precision(folders, make) -> None:
    model, batch = make(folders).train(), batch_of()
    expected = model(**batch)["loss"].item()
    with torch.autocast("cpu", torch.bfloat16):
        loss = model(**batch)["loss"]
    loss.backward()
    assert loss.item() == pytest.approx(expected, rel=0.05)
    assert all(p.grad.dtype == torch.float32 for p in model.parameters())


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
    put_parts(model, model.part_weights)
    theirs = halves(folders).llm_backbone.state_dict()
    for name, tensor in model.state_dict().items():
        part, _, rest = name.partition(".")
        expected = theirs[rest] if part == "llm_backbone" else before[name]
        assert torch.equal(tensor, expected), name
    assert model.pretrained_name_or_path is None
    strict = new(folders, **place)
    with pytest.raises(CheckpointError, match=r"1 left over: lm_head\.weight"):
        put_parts(strict, strict.part_weights)
    wrong = new(folders, **{**place, "name_mapping": {"llm_backbone.": "model."}})
    with pytest.raises(CheckpointError, match=r"missing: model\.model\.embed_tokens\.weight"):
        put_parts(wrong, wrong.part_weights)


def test_names_of_no_place_are_refused(folders: dict[str, str]) -> None:
    for more in (
        {"name_mapping": {"llm_backbone.": ""}},
        {"name_mapping": {}, "pretrained_name_or_path": folders["qwen3"]},
    ):
        with pytest.raises(ConfigError, match="name_mapping says how weights are called in"):
            new(folders, **more)


def test_its_latency_is_measured(folders: dict[str, str], tmp_path: Path) -> None:
    """``bench-policy`` on a robot with two cameras, from images and joints to commands."""
    words = tmp_path / "words"
    words.mkdir()
    known = {"<pad>": 0, "<unk>": 1, **{f"word{i}": i for i in range(2, 50)}}
    made = Tokenizer(WordLevel(known, unk_token="<unk>"))
    made.pre_tokenizer = Whitespace()
    made.save(str(words / "tokenizer.json"))
    (words / "tokenizer_config.json").write_text(json.dumps({"pad_token": "<pad>"}))
    vision = {"type": "SigLIPBackbone", "model_folder": folders["siglip"], "num_cameras": 2}
    model = {
        "type": "LlavaVLA",
        "vision_backbone": vision,
        "projector": {"type": "FusedMLPProjector"},
        "llm_backbone": {"type": "Qwen3Backbone", "model_folder": folders["qwen3"]},
        "vla_head": {**HEAD, "state_dim": 3},
    }
    tokenizer = {"type": "PretrainedTokenizer", "model_path": str(words)}
    dataset = {
        "type": "ParquetDataset",
        "img_keys": ["observation.images.front", "observation.images.wrist"],
        "transforms": [
            {"type": "ResizeImages", "height": 32, "width": 32},
            {"type": "SimpleNormalizeImages"},
            {"type": "NormalizeStatesAndActions", "norm_type": "mean_std"},
            {"type": "ProcessPrompts", "tokenizer": tokenizer, "max_len": 96},
        ],
    }
    robot = EmbodimentSpec(
        "arm",
        tuple(Joint(name, "rad", -1.0, 1.0, 1.0, 1.0) for name in "abc"),
        (Camera("front", 40, 48), Camera("wrist", 24, 32)),
        50.0,
    )
    (tmp_path / "embodiment.json").write_text(json.dumps(robot.to_dict()))
    config = tmp_path / "llava.py"
    config.write_text(f"model = {model!r}\ntrain_dataloader = dict(dataset={dataset!r})\n")
    told = ["--config", str(config), "--embodiment", str(tmp_path)]
    assert stages_measured(told, tmp_path / "measured") == WHOLE
