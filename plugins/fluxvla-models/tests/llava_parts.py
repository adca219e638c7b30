"""Tiny pretrained parts, as transformers saves them, and LlavaVLAs of them."""

from __future__ import annotations

import pytest
import torch
import transformers
from fluxvla_models.llava_vla import LlavaVLA

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
