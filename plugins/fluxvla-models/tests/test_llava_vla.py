"""LlavaVLA of tiny pretrained parts: it trains and acts; padding and batch size do not matter."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from fluxvla_models.llava_vla import LlavaVLA
from fluxvla_models.pretrained_backbones import (
    PaliGemmaBackbone,
    Qwen3Backbone,
    SigLIPBackbone,
)
from tokenizers import Tokenizer
from tokenizers.models import WordLevel
from tokenizers.pre_tokenizers import Whitespace

from fluxvla_core.errors import ConfigError
from fluxvla_core.spec import Camera, EmbodimentSpec, Joint
from tests.policies.benched import WHOLE, stages_measured
from tests.training.adapters import OWN, adapted, idle_parameters, shipped

from .llava_parts import HEAD, asked, batch_of, folders, halves, whole

__all__ = ["folders"]


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
def test_padding_on_either_side_and_other_samples_do_not_matter(folders, make) -> None:
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
def test_images_words_and_states_matter_and_a_missing_camera_does_not(folders, make) -> None:
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
    with pytest.raises(ConfigError, match="the model is a qwen3; siglip_vision_model or siglip is"):
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


@pytest.mark.parametrize("make", [halves, whole])
def test_in_mixed_precision(folders, make) -> None:
    model, batch = make(folders).train(), batch_of()
    expected = model(**batch)["loss"].item()
    with torch.autocast("cpu", torch.bfloat16):
        loss = model(**batch)["loss"]
    loss.backward()
    assert loss.item() == pytest.approx(expected, rel=0.05)
    assert all(p.grad.dtype == torch.float32 for p in model.parameters())


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
    options = ["--config", str(config), "--embodiment", str(tmp_path)]
    assert stages_measured(options, tmp_path / "measured") == WHOLE


def test_the_models_own_lora_layers_are_those_of_the_config(folders) -> None:
    pytest.importorskip("peft")
    found = adapted(halves(folders), OWN)
    assert found == adapted(halves(folders), shipped("llava_aloha_lora.py"))


@pytest.mark.parametrize("make", [halves, whole])
def test_every_adapter_of_the_models_own_layers_trains(folders, make) -> None:
    pytest.importorskip("peft")
    model = make(folders)
    idle = idle_parameters(model, OWN, batch_of())
    # The first layer's queries are zeros, which a norm's scale leaves as they are.
    assert [name for name in idle if not name.endswith("decoder.layers.0.norm1.weight")] == []
    trained = {name for name, p in model.named_parameters() if p.requires_grad}
    assert any(".layers.1.mlp.down_proj.lora_" in name for name in trained)
    assert not any("vision" in name for name in trained)
