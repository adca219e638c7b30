"""Writing a SmolVLA as LeRobot 0.6 saves one: config, weights, and processors with statistics."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from fluxvla_models.lerobot_files import (
    ACTION,
    EPS,
    POSTPROCESSOR,
    PREPROCESSOR,
    STATE,
    full_tensor,
    write_steps,
)
from safetensors.torch import save_file

from fluxvla_core.errors import CheckpointError
from fluxvla_core.models import ForeignCheckpoint
from fluxvla_smolvla.lerobot_files import NORMS, Statistics, published_names
from fluxvla_smolvla.model import SMOLVLM2
from fluxvla_smolvla.sizes import TextSize, VisionSize, size_of

_FEATURES = {"proprio": STATE, "action": ACTION}
_SETTINGS = (
    "max_state_dim",
    "max_action_dim",
    "num_steps",
    "self_attn_every_n_layers",
    "expert_width_multiplier",
    "min_period",
    "max_period",
    "freeze_vision_encoder",
    "train_expert_only",
    "train_state_proj",
)
"""Settings of the model that have the same name and default in LeRobot."""


def write(checkpoint: ForeignCheckpoint, folder: Path) -> None:
    """Write ``checkpoint`` into the empty ``folder``; weights keep their dtype.

    Raises:
        CheckpointError: its transforms are not those that LeRobot has, or it has no statistics.
    """
    # A type may be named with its distribution.
    transforms = {str(t.get("type")).rpartition(":")[2]: t for t in checkpoint.transforms}
    missing = [
        name
        for name in ("SmolVLAImages", "SmolVLANormalize", "SmolVLAPrompt", "ProcessPrompts")
        if name not in transforms
    ]
    if missing:
        raise CheckpointError(
            f"the transforms have no {missing[0]}: LeRobot would prepare observations otherwise",
            next="train with the transforms of SmolVLA, see the README of fluxvla-smolvla",
        )
    statistics = _statistics(checkpoint)
    config = _config(checkpoint, transforms, statistics)
    (folder / "config.json").write_text(json.dumps(config, indent=2) + "\n", encoding="utf-8")
    names = published_names(checkpoint.tensors)
    tensors = {theirs: full_tensor(checkpoint.tensors[ours]) for ours, theirs in names.items()}
    save_file(
        {name: tensor.contiguous() for name, tensor in tensors.items()},
        folder / "model.safetensors",
        metadata={"format": "pt"},
    )
    norms = {"eps": EPS, "norm_map": config["normalization_mapping"]}
    inputs, outputs = config["input_features"], config["output_features"]
    tokenized = {
        "max_length": config["tokenizer_max_length"],
        "task_key": "task",
        "padding_side": "right",
        "padding": "longest",
        "truncation": True,
        "tokenizer_name": config["vlm_model_name"],
    }
    before = [
        ("rename_observations_processor", {"rename_map": {}}),
        ("to_batch_processor", {}),
        ("smolvla_new_line_processor", {}),
        ("tokenizer_processor", tokenized),
        ("device_processor", {"device": "cpu", "float_dtype": None}),
        ("normalizer_processor", {**norms, "features": {**inputs, **outputs}}),
    ]
    after = [
        ("unnormalizer_processor", {**norms, "features": outputs}),
        ("device_processor", {"device": "cpu", "float_dtype": None}),
    ]
    flat = {
        f"{feature}.{name}": torch.tensor(values, dtype=torch.float32)
        for feature, entry in statistics.items()
        for name, values in entry.items()
    }
    for stem, steps in ((PREPROCESSOR, before), (POSTPROCESSOR, after)):
        write_steps(
            folder,
            stem,
            [(n, s, flat if n.endswith("normalizer_processor") else {}) for n, s in steps],
        )


def _config(
    checkpoint: ForeignCheckpoint,
    transforms: Mapping[Any, Mapping[str, Any]],
    statistics: Statistics,
) -> dict[str, Any]:
    model = checkpoint.model
    vision, text = size_of(VisionSize, model.get("vision")), size_of(TextSize, model.get("text"))
    side, empty = vision.image_size, transforms["SmolVLAImages"].get("empty_cameras", 0)
    robot = checkpoint.embodiment
    sizes = {c.name: [3, c.height, c.width] for c in robot.cameras} if robot is not None else {}
    cameras = {name: sizes.get(name, [3, side, side]) for name in checkpoint.img_keys}
    cameras |= {f"empty_camera_{i}": [3, 480, 640] for i in range(empty)}
    scaled = transforms["SmolVLANormalize"]
    names = {ours: theirs for theirs, ours in NORMS.items()}
    inputs = {STATE: {"type": "STATE", "shape": _shape(statistics, STATE)}}
    inputs |= {
        f"observation.images.{name}": {"type": "VISUAL", "shape": shape}
        for name, shape in cameras.items()
    }
    return {
        "type": "smolvla",
        "n_obs_steps": 1,
        "input_features": inputs,
        "output_features": {
            ACTION: {
                "type": "ACTION",
                "shape": _shape(statistics, ACTION),
            }
        },
        "normalization_mapping": {
            "VISUAL": "IDENTITY",
            "STATE": names[scaled.get("state_norm", "mean_std")],
            "ACTION": names[scaled.get("action_norm", "mean_std")],
        },
        "chunk_size": checkpoint.horizon,
        "n_action_steps": checkpoint.horizon,
        "resize_imgs_with_padding": [side, side],
        "empty_cameras": empty,
        "tokenizer_max_length": transforms["ProcessPrompts"].get("max_len", 48),
        "vlm_model_name": model.get("vlm_model_name", SMOLVLM2),
        "load_vlm_weights": False,
        "num_vlm_layers": text.layers,
        "num_expert_layers": model.get("num_expert_layers") or -1,
        **{name: model[name] for name in _SETTINGS if name in model},
    }


def _statistics(checkpoint: ForeignCheckpoint) -> Statistics:
    entries = checkpoint.statistics.get("private", {})
    lacking = [name for name in _FEATURES if not entries.get(name)]
    if lacking:
        raise CheckpointError(
            f"the checkpoint has no statistics of {lacking[0]!r}: LeRobot's would not act"
        )
    return {
        feature: {
            name: values
            for name, values in entries[ours].items()
            if isinstance(values, list) and name != "count"
        }
        for ours, feature in _FEATURES.items()
    }


def _shape(statistics: Statistics, feature: str) -> list[int]:
    return [len(next(iter(statistics[feature].values())))]
