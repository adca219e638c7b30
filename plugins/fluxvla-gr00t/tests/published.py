"""Folders as NVIDIA publishes GR00T, with tiny models."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from fluxvla_gr00t import lerobot_format, tables
from fluxvla_gr00t.gr00t import GR00T
from fluxvla_gr00t.names import published_name
from safetensors.torch import save_file

from fluxvla_core.operators import Camera, EmbodimentSpec, Joint
from tests.oracles import fill

from .gr00t_sizes import TINY_N15, TINY_N17

MARKS = {
    "n1.5": ("<|im_start|>", "<|im_end|>", "<img>", "</img>", "<IMG_CONTEXT>"),
    "n1.7": ("<|im_start|>", "<|im_end|>", "<|vision_start|>", "<|vision_end|>", "<|image_pad|>"),
}
# The last of the marks, behind 256 bytes.
PLACE = 260
SIDES = {"n1.5": 28, "n1.7": 64}
BACKBONES = {
    "n1.5": {**TINY_N15["vlm_backbone"], "vocabulary": 261, "image_token": PLACE},
    "n1.7": {
        **TINY_N17["vlm_backbone"],
        "vocabulary": 261,
        "image_token": PLACE,
        "patch_size": 16,
    },
}
HEADS = {"n1.5": TINY_N15["vla_head"], "n1.7": TINY_N17["vla_head"]}
LAYERS = {"n1.5": 2, "n1.7": 3}
CAMERAS = ("front", "wrist")
WIDTHS = {"arm": 4, "grip": 1}
UNREAD = {
    "n1.5": (
        "backbone.eagle_model.language_model.lm_head.weight",
        "backbone.eagle_model.vision_model.vision_model.head.probe",
    ),
    "n1.7": ("backbone.model.lm_head.weight", "backbone.model.model.language_model.norm.weight"),
}


def robot(side: int) -> EmbodimentSpec:
    """Five joints and two cameras."""
    joints = tuple(Joint(f"j{i}", "rad", -3.0, 3.0, 1.0, 1.0) for i in range(5))
    return EmbodimentSpec("arm", joints, tuple(Camera(c, side, side) for c in CAMERAS), 20.0)


def statistics(kind: str) -> dict[str, dict[str, list[float]]]:
    """Of both groups; the gripper's state never moves."""
    made = {}
    for group, width in WIDTHS.items():
        middle = fill.normal(f"{kind} {group}", (width,)).astype(float)
        still = 0.0 if (kind, group) == ("state", "grip") else 1.0
        made[group] = {
            "min": (middle - 2 * still).tolist(),
            "max": (middle + 3 * still).tolist(),
            "mean": middle.tolist(),
            "std": [still] * width,
            "q01": (middle - still).tolist(),
            "q99": (middle + 2 * still).tolist(),
        }
    return made


def joined(kind: str, name: str) -> np.ndarray:
    """One statistic of both groups."""
    return np.concatenate([group[name] for group in statistics(kind).values()])


def tokenizer(version: str, folder: Path) -> Path:
    """Bytes, and the marks of a chat with images."""
    from tokenizers import Tokenizer, decoders, models, pre_tokenizers

    alphabet = sorted(pre_tokenizers.ByteLevel.alphabet())
    made = Tokenizer(models.BPE({c: i for i, c in enumerate(alphabet)}, []))
    made.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    made.decoder = decoders.ByteLevel()
    made.add_special_tokens(list(MARKS[version]))
    folder.mkdir()
    made.save(str(folder / "tokenizer.json"))
    return folder


def model(version: str, **settings: object) -> GR00T:
    """The tiny model, filled."""
    made = GR00T(BACKBONES[version], {**HEADS[version], **settings})
    state = {
        name: torch.from_numpy(fill.weight(published_name(name, version), value.shape))
        for name, value in made.state_dict().items()
    }
    made.load_state_dict(state)
    return made.eval()


def folder(version: str, place: Path, monkeypatch, tags=("new_embodiment",)) -> Path:
    """The published folder of the tiny model, whose backbone is known while a test runs."""
    monkeypatch.setitem(tables.BACKBONES, version, BACKBONES[version])
    place.mkdir()
    tensors = {
        published_name(name, version): value for name, value in model(version).state_dict().items()
    }
    tensors |= {name: torch.zeros(2, 2) for name in UNREAD[version]}
    save_file(tensors, place / "model.safetensors")
    (_write_n15 if version == "n1.5" else _write_n17)(place, tags)
    return place


def lerobot_folder(version: str, place: Path, monkeypatch, **pack: object) -> Path:
    """The tiny model as LeRobot saves it: by 0.4.4 N1.5, by 0.6.1 N1.7; ``pack`` adds settings."""
    monkeypatch.setitem(tables.BACKBONES, version, BACKBONES[version])
    monkeypatch.setitem(lerobot_format.HEADS, version, HEADS[version])
    head = HEADS[version]
    place.mkdir()
    tensors = {
        f"_groot_model.{published_name(name, version)}": value
        for name, value in model(version).state_dict().items()
    }
    tensors |= {f"_groot_model.{name}": torch.zeros(2, 2) for name in UNREAD[version]}
    save_file(tensors, place / "model.safetensors")
    images = {f"observation.images.{camera}": {"type": "VISUAL"} for camera in CAMERAS}
    state = {"observation.state": {"type": "STATE", "shape": [5]}}
    write(place / "config.json", {"type": "groot", "input_features": {**images, **state}})
    name = {"n1.5": "groot_pack_inputs_v3", "n1.7": "groot_n1_7_pack_inputs_v1"}[version]
    file = f"policy_preprocessor_step_2_{name}.safetensors"
    config = {
        "max_state_dim": head["state_dim"],
        "max_action_dim": head["action_dim"],
        "formalize_language": version == "n1.7",
        "embodiment_tag": "new_embodiment",
        "embodiment_mapping": {"new_embodiment": 2, "gr1": 1},
        "normalize_min_max": True,
        **({"clip_outliers": True, "use_percentiles": False} if version == "n1.7" else {}),
        **pack,
    }
    encode = {"image_target_size": [64, 64], "image_crop_size": [64, 64]}
    steps = [
        {"registry_name": "rename_observations_processor", "config": {"rename_map": {}}},
        {"registry_name": "to_batch_processor", "config": {}},
        {"registry_name": name, "config": config, "state_file": file},
        {"registry_name": "groot_n1_7_vlm_encode_v1", "config": encode},
    ]
    write(place / "policy_preprocessor.json", {"name": "policy_preprocessor", "steps": steps})
    undo = {"registry_name": "groot_action_unpack_unnormalize_v2", "config": {"env_action_dim": 5}}
    write(place / "policy_postprocessor.json", {"name": "policy_postprocessor", "steps": [undo]})
    numbers = {
        f"{feature}.{name}": torch.from_numpy(joined(kind, name))
        for feature, kind in (("observation.state", "state"), ("action", "action"))
        for name in ("min", "max", "mean", "std")
    }
    save_file(numbers, place / file)
    return place


def write(path: Path, content: object) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(content))


def _dit(head: dict[str, object]) -> dict[str, object]:
    return {
        "norm_type": "ada_norm",
        "positional_embeddings": None,
        "interleave_self_attention": True,
        "output_dim": head["hidden_dim"],
        "num_layers": head["layers"],
        "num_attention_heads": head["heads"],
        "attention_head_dim": head["head_dim"],
        "dropout": 0.0,
    }


def _common(head: dict[str, object]) -> dict[str, object]:
    return {
        "action_horizon": head["horizon"],
        "max_state_dim": head["state_dim"],
        "max_num_embodiments": head["embodiments"],
        "hidden_size": head["hidden_dim"],
        "max_seq_len": head["max_steps"],
        "num_inference_timesteps": 4,
        "diffusion_model_cfg": _dit(head),
        "vl_self_attention_cfg": {
            "positional_embeddings": None,
            "num_layers": head["context_layers"],
            "num_attention_heads": head["context_heads"],
            "dropout": 0.0,
        },
    }


def _write_n15(place: Path, tags: tuple[str, ...]) -> None:
    head = HEADS["n1.5"]
    config = {
        "model_type": "gr00t_n1_5",
        "backbone_cfg": {"select_layer": LAYERS["n1.5"], "project_to_dim": None},
        "action_head_cfg": {
            **_common(head),
            "action_dim": head["action_dim"],
            "num_target_vision_tokens": head["future_tokens"],
        },
    }
    write(place / "config.json", config)
    groups = {name: {"shape": [width]} for name, width in WIDTHS.items()}
    facts = {
        "statistics": {"state": statistics("state"), "action": statistics("action")},
        "modalities": {
            "video": {camera: {"fps": 20.0} for camera in CAMERAS},
            "state": groups,
            "action": groups,
        },
    }
    write(place / "experiment_cfg" / "metadata.json", dict.fromkeys(tags, facts))


def _write_n17(place: Path, tags: tuple[str, ...]) -> None:
    head = HEADS["n1.7"]
    config = {
        "model_type": "Gr00tN1d7",
        **_common(head),
        "select_layer": LAYERS["n1.7"],
        "max_action_dim": head["action_dim"],
        "use_alternate_vl_dit": True,
        "attend_text_every_n_blocks": 2,
        "state_dropout_prob": 0.2,
    }
    write(place / "config.json", config)
    modalities = {
        "video": {"modality_keys": list(CAMERAS), "delta_indices": [0]},
        "state": {"modality_keys": list(WIDTHS)},
        "action": {
            "modality_keys": list(WIDTHS),
            "delta_indices": list(range(6)),
            "action_configs": [{"rep": "ABSOLUTE"}] * 2,
        },
    }
    kwargs = {
        "modality_configs": dict.fromkeys(tags, modalities),
        "use_percentiles": True,
        "image_target_size": [64, 64],
        "image_crop_size": [64, 64],
    }
    write(place / "processor_config.json", {"processor_kwargs": kwargs})
    facts = {"state": statistics("state"), "action": statistics("action")}
    write(place / "statistics.json", dict.fromkeys(tags, facts))
    write(place / "embodiment_id.json", dict.fromkeys(tags, 2))
