"""The shipped ALOHA config of every family with a model of a few thousand weights.

All but sizes, tokenizers, data and robot stays as it is shipped: transforms and their order,
collator, optimizer, schedule.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fluxvla_core.config.load import load_config

CONFIGS = Path(__file__).parents[2] / "configs"
CAMERAS = ("top", "angle")
HEIGHT, WIDTH, HORIZON, JOINTS = 36, 48, 8, 14
SHIPPED = {
    "pi0": "pi0_aloha",
    "pi05": "pi05_aloha",
    "pi0_fast": "pi0_fast_aloha",
    "gr00t_n15": "gr00t_n15_aloha",
    "gr00t_n17": "gr00t_n17_aloha",
    "smolvla": "smolvla_aloha_sim",
    "openvla": "openvla_aloha",
    "openvla_oft": "openvla_oft_aloha",
    "compact": "aloha_sim_transfer",
    "llava": "llava_aloha",
    "act": "aloha_sim_act",
    "diffusion": "aloha_sim_diffusion",
}
CONTINUES = ("pi0", "pi05", "gr00t_n15", "gr00t_n17", "smolvla", "compact")
"""Families whose chunks can be joined by real-time chunking."""
MARKS = (
    "<|im_start|>",
    "<|im_end|>",
    "<img>",
    "</img>",
    "<IMG_CONTEXT>",
    "<|vision_start|>",
    "<|vision_end|>",
    "<|image_pad|>",
)
_VOCABULARY = 256 + len(MARKS)
_EAGLE, _QWEN = 260, 263
"""Ids of the image tokens among the marks."""
_ACTIONS = {"vocab_size": 1024, "bos": 4, "begin": [1], "stop": 2, "eos": 3}
_GEMMA = {"width": 16, "depth": 2, "mlp_dim": 24, "heads": 8, "kv_heads": 1, "head_dim": 8}
_SIGLIP = {"width": 16, "depth": 1, "mlp_dim": 24, "heads": 16, "image_size": 28, "patch_size": 14}
_TEXT = {
    "text_dim": 16,
    "text_layers": 2,
    "text_heads": 4,
    "text_kv_heads": 2,
    "text_head_dim": 8,
    "text_mlp": 24,
    "vocabulary": _VOCABULARY,
}
_HEAD = {
    "horizon": HORIZON,
    "embodiments": 32,
    "heads": 2,
    "head_dim": 8,
    "hidden_dim": 12,
    "context_layers": 1,
    "context_heads": 2,
    "layers": 2,
}
_TOWERS = {
    "image_size": 28,
    "dino": {"width": 16, "depth": 2, "num_heads": 2, "mlp_width": 24},
    "siglip": {"width": 16, "depth": 2, "num_heads": 2, "mlp_width": 24},
    "language": {
        "hidden_size": 16,
        "intermediate_size": 24,
        "num_hidden_layers": 1,
        "num_attention_heads": 2,
        "num_key_value_heads": 2,
        "vocab_size": 416,
        "text_vocab_size": 384,
    },
}
_HALF = {
    "hidden_size": 16,
    "intermediate_size": 24,
    "num_hidden_layers": 1,
    "num_attention_heads": 2,
}


def sizes_of(family: str, folder: Path) -> dict[str, Any]:
    """What differs from the shipped config's ``model``; a table replaces what is there."""
    if family in ("pi0", "pi05"):
        variants = {"variant": _GEMMA, "expert_variant": _GEMMA, "vision_variant": _SIGLIP}
        return {**variants, "n_action_steps": HORIZON, "vocab_size": _VOCABULARY, "num_steps": 2}
    if family == "pi0_fast":
        return {
            "variant": _GEMMA,
            "vision_variant": _SIGLIP,
            "tokenizer": {"type": "FastTokenizer", "model_path": str(folder / "fast")},
            "n_action_steps": HORIZON,
            "vocab_size": 1024,
            "words": _ACTIONS,
            "max_decoding_steps": 12,
        }
    if family == "gr00t_n15":
        vision = {"image_size": 28, "vision_dim": 12, "vision_layers": 1, "vision_heads": 2}
        backbone = {**vision, "vision_mlp": 20, **_TEXT, "image_token": _EAGLE}
        return {
            "vlm_backbone": {"type": "EagleBackbone", "patch_size": 14, **backbone},
            "vla_head": {"type": "GR00TActionHead", **_HEAD, "ori_action_dim": JOINTS},
        }
    if family == "gr00t_n17":
        vision = {"vision_dim": 16, "vision_layers": 2, "vision_heads": 2, "vision_mlp": 20}
        more = {"vision_positions": 16, "deepstack": [0], "rope_sections": [2, 1, 1]}
        head = {"action_dim": 132, "state_dim": 132, "future_tokens": 0, "attend_text_every": 2}
        backbone = {**vision, **more, **_TEXT, "image_token": _QWEN}
        return {
            "vlm_backbone": {"type": "Qwen3VLBackbone", **backbone},
            "vla_head": {
                "type": "GR00TActionHead",
                **_HEAD,
                **head,
                "layers": 4,
                "ori_action_dim": JOINTS,
            },
        }
    if family == "smolvla":
        vision = {"hidden_size": 64, "intermediate_size": 96, "layers": 1, "heads": 1}
        text = {"hidden_size": 128, "intermediate_size": 160, "layers": 2, "heads": 2}
        return {
            "vision": {**vision, "image_size": 64, "patch_size": 8, "scale_factor": 2},
            "text": {**text, "kv_heads": 1, "vocabulary": _VOCABULARY},
            "n_action_steps": HORIZON,
            "num_steps": 2,
        }
    if family == "openvla":
        return _TOWERS
    if family == "openvla_oft":
        return {**_TOWERS, "horizon": HORIZON, "num_images": len(CAMERAS)}
    if family == "compact":
        return {
            "vision_backbone": {"type": "ConvEncoder", "image_size": [32, 32], "num_cameras": 2},
            "projector": {"type": "FiLMProjector", "width": 16},
            "vla_head": {
                "type": "FlowMatchingHead",
                "horizon": HORIZON,
                "action_dim": JOINTS,
                "width": 16,
                "blocks": 1,
                "num_steps": 2,
            },
        }
    if family == "llava":
        vision = {"model_type": "siglip_vision_model", **_HALF, "image_size": 28, "patch_size": 14}
        text = {"model_type": "qwen3", **_HALF, "num_key_value_heads": 1, "head_dim": 8}
        nowhere = {"model_folder": str(folder / "nowhere"), "pretrained": False}
        return {
            "vision_backbone": {
                "type": "SigLIPBackbone",
                "num_cameras": len(CAMERAS),
                "sizes": vision,
                **nowhere,
            },
            "llm_backbone": {
                "type": "Qwen3Backbone",
                "sizes": {**text, "vocab_size": _VOCABULARY},
                **nowhere,
            },
            "vla_head": {
                "type": "LlavaActionHead",
                "horizon": HORIZON,
                "action_dim": JOINTS,
                "state_dim": JOINTS,
                "width": 16,
                "num_heads": 2,
                "num_layers": 1,
            },
        }
    seen = {"horizon": HORIZON, "num_cameras": len(CAMERAS), "backbone_width": 8}
    if family == "act":
        layers = {"n_encoder_layers": 1, "n_vae_encoder_layers": 1, "dim_feedforward": 24}
        return {**seen, **layers, "dim_model": 16, "n_heads": 2}
    return {**seen, "keypoints": 4, "crop_shape": [28, 40], "down_dims": [8, 16]}


_RESIZED: dict[str, dict[str, Any]] = {
    "ResizeImagesWithPad": {"height": 28, "width": 28},
    "ResizeOpenVLAImages": {"size": 28},
    "CropImages": {"top": 0, "left": 0, "height": 32, "width": 32},
    "ProcessPromptsWithImage": {"num_images": 2, "fixed_img_tokens": 4, "max_len": 300},
    "ProcessQwenPrompts": {"max_len": 300},
    "ResizeCropImages": {"size": 32},
    "ProcessPrompts": {"max_len": 300},
    "ProcessOpenVLAPrompts": {"empty_token": 3},
    "ProcessActionTokens": {"words": _ACTIONS, "max_len": 256},
}
"""Transform -> arguments that belong to the sizes."""
_SIDES = {"gr00t_n15": (28, 28), "llava": (28, 28)}


def tiny(family: str, folder: Path, data: Path) -> Path:
    """The config of ``family`` in ``folder``: trained on ``data``, acting in the simulation."""
    write_tokenizers(folder, family)
    tree = load_config(CONFIGS / f"{SHIPPED[family]}.py").tree
    model = {**tree["model"], **sizes_of(family, folder)}
    model.pop("pretrained_name_or_path", None)
    loader, runner = tree["train_dataloader"], tree["runner"]
    loader |= {"per_device_batch_size": 2, "per_device_num_workers": 0}
    table = loader["dataset"]
    window = 1 if family == "openvla" else HORIZON
    cameras = CAMERAS[:1] if family == "openvla" else CAMERAS
    table |= {"data_root_path": str(data), "img_keys": list(cameras), "action_window_size": window}
    for transform in table["transforms"]:
        transform |= _RESIZED.get(transform["type"], {})
        if transform["type"] == "ResizeImages":
            transform["height"], transform["width"] = _SIDES.get(family, (HEIGHT, WIDTH))
        if family != "compact" and "tokenizer" in transform:
            actions = transform["type"] == "ProcessActionTokens"
            transform["tokenizer"] = (
                {"type": "FastTokenizer", "model_path": str(folder / "fast")}
                if actions
                else {"type": "PretrainedTokenizer", "model_path": str(folder / "words")}
            )
    runner |= {
        "max_steps": 4,
        "save_iter_interval": 2,
        "max_keep_ckpts": 0,
        "enable_mixed_precision_training": False,
        "lora": None,
        "init_from": None,
    }
    sections = {
        "model": model,
        "train_dataloader": loader,
        "runner": runner,
        "eval": {
            "type": "AlohaSimEvalRunner",
            "tasks": ["lift_hold"],
            "episodes": 1,
            "replan_every": window,
            "workers": 1,
            "record_videos": 0,
        },
        "inference": {
            "type": "AlohaInferenceRunner",
            "seed": 7,
            "task_descriptions": {"1": "pick up the cube with the right arm and hold it"},
            "execute_horizon": window if window < 4 else 4,
            "max_publish_step": 30,
            "operator": {
                "type": "AlohaSimOperator",
                "camera_names": cameras,
                "height": HEIGHT,
                "width": WIDTH,
            },
        },
    }
    file = folder / f"{family}.py"
    file.write_text("".join(f"{name} = {value!r}\n" for name, value in sections.items()))
    return file


def write_tokenizers(folder: Path, family: str, more: int = 0) -> None:
    """``words``: bytes and the marks of chats, or words as Llama 2's has them; ``fast``.

    Args:
        more: so many further words, which no instruction has.
    """
    from tokenizers import Tokenizer, models, pre_tokenizers, processors

    words = folder / "words"
    words.mkdir(exist_ok=True)
    unheard = [f"unheard{i}" for i in range(more)]
    if family.startswith("openvla"):
        known = {word: i for i, word in enumerate(["<unk>", "<s>", "</s>", *unheard])}
        made = Tokenizer(models.WordLevel(known, unk_token="<unk>"))
        made.pre_tokenizer = pre_tokenizers.Whitespace()
        made.post_processor = processors.TemplateProcessing("<s> $A", None, [("<s>", 1)])
    else:
        letters = [*sorted(pre_tokenizers.ByteLevel.alphabet()), *unheard]
        made = Tokenizer(models.BPE({letter: i for i, letter in enumerate(letters)}, []))
        made.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
        made.add_special_tokens(list(MARKS))
    made.save(str(words / "tokenizer.json"))
    (words / "tokenizer_config.json").write_text(json.dumps({"pad_token": "<|im_end|>"}))
    if family == "pi0_fast":
        from fluxvla_models.fast_tokenizer import fit

        chunks = np.random.default_rng(0).uniform(-1, 1, (60, HORIZON, JOINTS))
        fit(chunks, folder / "fast", vocab_size=400)


def weights(checkpoint: Path) -> Mapping[str, Any]:
    """The tensors of a checkpoint's model."""
    from safetensors.torch import load_file

    return load_file(checkpoint / "model.safetensors")
