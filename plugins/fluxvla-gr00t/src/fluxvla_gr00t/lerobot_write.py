"""Writing GR00T as LeRobot saves it: N1.7 as by its version 0.6, N1.5 as by 0.4.

LeRobot builds the model that NVIDIA published and then fills it, so that its files say no sizes;
models of other sizes are refused. Parts that nothing reads, but that LeRobot's files have, are
written as well: N1.7's last norm as ones, N1.5's pooling head as zeros, its output layer over words
as the embedding. N1.7's output layer shares the embedding's memory, and is not written.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from fluxvla_models.lerobot_files import (
    ACTION,
    CONFIG,
    POSTPROCESSOR,
    PREPROCESSOR,
    STATE,
    full_tensor,
    write_steps,
)
from safetensors.torch import save_file
from torch import Tensor

from fluxvla_core import build_transform_from_cfg
from fluxvla_core.errors import CheckpointError
from fluxvla_core.models import ForeignCheckpoint
from fluxvla_gr00t.action_head import GR00TActionHead
from fluxvla_gr00t.eagle import EagleBackbone
from fluxvla_gr00t.names import published_name
from fluxvla_gr00t.qwen3_vl import Qwen3VLBackbone
from fluxvla_gr00t.tables import BACKBONES, TOKENIZERS

Floats = npt.NDArray[np.float64]
PREFIX = "_groot_model."
IMAGES = "observation.images."
TAG = "new_embodiment"
_KINDS: Mapping[str, type] = {"n1.5": EagleBackbone, "n1.7": Qwen3VLBackbone}
_FREE = {
    "type",
    "ori_action_dim",
    "action_dim",
    "state_dim",
    "num_steps",
    "dropout",
    "state_dropout",
    "attend_padding",
    "mean_over_valid",
}
"""Arguments of the head that are in LeRobot's files, or matter in training alone."""
_RANGES = {"min_max": ("min", "max"), "quantile": ("q01", "q99")}
_ACTING = {
    "n1.5": ("ListInstruction", "ProcessPromptsWithImage", "ResizeImages", "SimpleNormalizeImages"),
    "n1.7": ("ResizeCropImages", "ProcessQwenPrompts", "SimpleNormalizeImages", "ClipNormalized"),
}
"""Transforms besides the normalisation that LeRobot's processors of a version do."""


@dataclass(frozen=True)
class Facts:
    """Facts of a checkpoint that LeRobot's config and processors hold.

    Args:
        version: ``n1.5`` or ``n1.7``.
        head: all arguments of the head.
        tables: the transforms that it acts with, by name.
        statistics: ``<feature>.<statistic>``; ``min`` becomes -1 and ``max`` 1.
        widths: of state and action.
    """

    version: str
    head: Mapping[str, Any]
    tables: Mapping[str, Mapping[str, Any]]
    statistics: Mapping[str, Tensor]
    widths: Mapping[str, int]


def write(checkpoint: ForeignCheckpoint, folder: Path, heads: Mapping[str, Any]) -> None:
    """Write ``checkpoint`` into the empty ``folder``; weights keep their dtype.

    Args:
        heads: of each version the arguments of the published head.

    Raises:
        CheckpointError: its sizes are not the published ones, or LeRobot's processors cannot do
            what its transforms do.
    """
    facts = _facts(checkpoint, heads)
    config = _config(checkpoint, facts)
    tensors = _tensors(checkpoint, facts.version)
    before, after = (_n15_steps if facts.version == "n1.5" else _n17_steps)(checkpoint, facts)
    (folder / CONFIG).write_text(json.dumps(config, indent=4) + "\n", encoding="utf-8")
    save_file(tensors, folder / "model.safetensors", {"format": "pt"})
    write_steps(folder, PREPROCESSOR, before)
    write_steps(folder, POSTPROCESSOR, after)


def _facts(checkpoint: ForeignCheckpoint, heads: Mapping[str, Any]) -> Facts:
    backbone = dict(checkpoint.model["vlm_backbone"])
    kind = str(backbone.get("type")).rpartition(":")[2]
    version = next((v for v, cls in _KINDS.items() if cls.__name__ == kind), None)
    if version is None:
        raise CheckpointError(f"LeRobot has no GR00T with the backbone {kind}")
    head = _arguments(GR00TActionHead, checkpoint.model["vla_head"])
    wanted = _arguments(GR00TActionHead, heads[version])
    pairs = [("vla_head", k, head[k], wanted[k]) for k in head.keys() - _FREE]
    own, other = (_arguments(_KINDS[version], t) for t in (backbone, BACKBONES[version]))
    pairs += [("vlm_backbone", k, own[k], other[k]) for k in own.keys() - {"type"}]
    if version == "n1.5":
        pairs.append(("vla_head", "num_steps", head["num_steps"], wanted["num_steps"]))
    for part, name, found, expected in sorted(pairs, key=lambda pair: pair[:2]):
        if _plain(found) != _plain(expected):
            raise CheckpointError(
                f"{part}.{name} is {found!r}; LeRobot's GR00T {version.upper()} has {expected!r}",
                cause="LeRobot's files say no sizes: it fills the model that NVIDIA published",
            )
    named = [(str(table["type"]).rpartition(":")[2], table) for table in checkpoint.transforms]
    known = (*_ACTING[version], "NormalizeStatesAndActions")
    tables = {
        name: table
        for name, table in named  # what matters in training alone is left out
        if name in known or not build_transform_from_cfg(dict(table)).training_only
    }
    numbers = tables.pop("NormalizeStatesAndActions", None)
    unknown = [name for name in tables if name not in _ACTING[version]]
    needed = [n for n in _ACTING[version] if n not in tables and n != "ClipNormalized"]
    if numbers is None or unknown or needed:
        what = f"{unknown[0]} is" if unknown else f"no {(*needed, 'normalisation')[0]} is"
        raise CheckpointError(
            f"{what} among the transforms; LeRobot's processors of GR00T {version.upper()} do "
            f"{', '.join(_ACTING[version])} and NormalizeStatesAndActions"
        )
    statistics: dict[str, Tensor] = {}
    widths: dict[str, int] = {}
    for feature, key, norm_type in (
        (STATE, numbers.get("state_key", "proprio"), numbers.get("state_norm_type")),
        (ACTION, numbers.get("action_key", "action"), None),
    ):
        entry = checkpoint.statistics.get("private", {}).get(key)
        rows = _rows(entry, numbers, norm_type or numbers.get("norm_type", "mean_std"), feature)
        widths[feature] = len(rows["min"])
        statistics |= {
            f"{feature}.{name}": torch.tensor(row, dtype=torch.float32)
            for name, row in rows.items()
        }
    return Facts(version, head, tables, statistics, widths)


def _rows(
    entry: Mapping[str, Any] | None, table: Mapping[str, Any], norm_type: str, feature: str
) -> dict[str, Floats]:
    """A feature's statistics as LeRobot normalises by them: by ``min`` and ``max``.

    Raises:
        CheckpointError: LeRobot cannot normalise so.
    """
    if not entry:
        raise CheckpointError(f"the checkpoint has no statistics of {feature}: it drives no robot")
    if norm_type not in _RANGES:
        raise CheckpointError(
            f"{feature} is normalised by {norm_type}; LeRobot's GR00T does it by a range",
            next="train with norm_type='min_max' or 'quantile'",
        )
    for name, plain in (("std_floor", 0.0), ("action_norm_mask", None)):
        if table.get(name, plain) != plain:
            raise CheckpointError(f"{name} is {table[name]!r}, which LeRobot's GR00T does not have")
    rows = {
        n: np.asarray(entry[n], np.float64) for n in ("mean", "std", "min", "max") if n in entry
    }
    low, high = (np.asarray(entry[name], np.float64) for name in _RANGES[norm_type])
    if low.ndim != 1 or entry.get("relative") is not None:
        raise CheckpointError(
            f"statistics of {feature} are of each step, or count from the state, which is not "
            "written for LeRobot"
        )
    if not table.get("epsilon_if_zero", False):
        high = high + float(table.get("epsilon", 1e-6))
    if norm_type == "min_max" and "std" in rows:
        # What never moves was given a range of 2 around it when it was imported.
        still = (rows["std"] == 0) & (high - low == 2) & (rows["mean"] == (low + high) / 2)
        low, high = np.where(still, low + 1, low), np.where(still, high - 1, high)
    return {**rows, "min": low, "max": high}


def _config(checkpoint: ForeignCheckpoint, facts: Facts) -> dict[str, Any]:
    robot = checkpoint.embodiment
    seen = {c.name: [3, c.height, c.width] for c in robot.cameras} if robot is not None else {}
    side = 224 if facts.version == "n1.5" else 256
    inputs: dict[str, Any] = {
        IMAGES + name: {"type": "VISUAL", "shape": seen.get(name, [3, side, side])}
        for name in checkpoint.img_keys
    }
    inputs[STATE] = {"type": "STATE", "shape": [facts.widths[STATE]]}
    config = {
        "type": "groot",
        "n_obs_steps": 1,
        "input_features": inputs,
        "output_features": {ACTION: {"type": "ACTION", "shape": [facts.widths[ACTION]]}},
        "device": "cpu",
        "chunk_size": checkpoint.horizon,
        "n_action_steps": checkpoint.horizon,
        "max_state_dim": facts.head["state_dim"],
        "max_action_dim": facts.head["action_dim"],
        "normalization_mapping": dict.fromkeys(("VISUAL", "STATE", "ACTION"), "IDENTITY"),
        "embodiment_tag": TAG,
    }
    if facts.version == "n1.7" and "num_steps" in checkpoint.model["vla_head"]:
        config["num_inference_timesteps"] = facts.head["num_steps"]
    return config


def _packing(checkpoint: ForeignCheckpoint, facts: Facts) -> dict[str, Any]:
    """Settings that the packing steps of both versions share."""
    return {
        "state_horizon": 1,
        "action_horizon": checkpoint.horizon,
        "max_state_dim": facts.head["state_dim"],
        "max_action_dim": facts.head["action_dim"],
        "language_key": "task",
        "embodiment_tag": TAG,
        "embodiment_mapping": {TAG: checkpoint.model.get("embodiment_id", 0)},
        "normalize_min_max": True,
    }


Step = tuple[str, Mapping[str, Any], Mapping[str, Tensor]]
_FIRST: tuple[Step, ...] = (
    ("rename_observations_processor", {"rename_map": {}}, {}),
    ("to_batch_processor", {}, {}),
)
_LAST: Step = ("device_processor", {"device": "cpu", "float_dtype": None}, {})


def _n15_steps(checkpoint: ForeignCheckpoint, facts: Facts) -> tuple[list[Step], list[Step]]:
    names = list(checkpoint.img_keys)
    if names != sorted(names):
        raise CheckpointError(
            f"the cameras are {', '.join(names)}; LeRobot's GR00T N1.5 takes them in the order of "
            "the alphabet",
            next="give them names that sort so: --camera OLD=NEW of fluxvla import-checkpoint",
        )
    pack = {**_packing(checkpoint, facts), "formalize_language": False}
    words = {"tokenizer_assets_repo": TOKENIZERS["n1.5"]}
    before: list[Step] = [
        *_FIRST,
        ("groot_pack_inputs_v3", pack, facts.statistics),
        ("groot_eagle_encode_v3", words, {}),
        ("groot_eagle_collate_v3", words, {}),
        _LAST,
    ]
    undo = {"env_action_dim": facts.widths[ACTION], "normalize_min_max": True}
    return before, [("groot_action_unpack_unnormalize_v1", undo, facts.statistics), _LAST]


def _n17_steps(checkpoint: ForeignCheckpoint, facts: Facts) -> tuple[list[Step], list[Step]]:
    images, prompts = (facts.tables[n] for n in ("ResizeCropImages", "ProcessQwenPrompts"))
    size = int(images.get("size", 256))
    pack = {
        **_packing(checkpoint, facts),
        "valid_action_horizon": checkpoint.horizon,
        "video_horizon": None,
        "formalize_language": bool(prompts.get("formalize", True)),
        "state_dropout_prob": facts.head["state_dropout"],
        "clip_outliers": "ClipNormalized" in facts.tables,
        "use_percentiles": False,
        "video_modality_keys": list(checkpoint.img_keys),
        "raw_stats": None,
        "modality_config": None,
    }
    encode = {
        "model_name": TOKENIZERS["n1.7"],
        "image_crop_size": None,
        "image_target_size": [size, size],
        "shortest_image_edge": images.get("shortest_edge"),
        "crop_fraction": float(images.get("crop_fraction", 230 / 256)),
        "use_albumentations": images.get("method", "bicubic") == "area",
        "letter_box_transform": bool(images.get("letter_box", False)),
        "device": "cpu",
    }
    before: list[Step] = [
        *_FIRST,
        ("groot_n1_7_pack_inputs_v1", pack, facts.statistics),
        ("groot_n1_7_vlm_encode_v1", encode, {}),
        _LAST,
    ]
    undo = {
        "env_action_dim": facts.widths[ACTION],
        "normalize_min_max": True,
        "clip_normalized_action": False,
        "libero_gripper_action": False,
        "libero_gripper_binarize": True,
    }
    return before, [("groot_action_unpack_unnormalize_v2", undo, facts.statistics), _LAST]


def _tensors(checkpoint: ForeignCheckpoint, version: str) -> dict[str, Tensor]:
    """All weights under LeRobot's names, with those that nothing reads."""
    tensors = {
        published_name(name, version): full_tensor(tensor).contiguous()
        for name, tensor in checkpoint.tensors.items()
    }
    if version == "n1.7":
        text = "backbone.model.model.language_model."
        embedding = tensors[f"{text}embed_tokens.weight"]
        tensors[f"{text}norm.weight"] = torch.ones(embedding.shape[1], dtype=embedding.dtype)
    else:
        language = "backbone.eagle_model.language_model."
        embedding = tensors[f"{language}model.embed_tokens.weight"]
        tensors[f"{language}lm_head.weight"] = embedding.clone()
        tensors |= _pooling(tensors)
    return {PREFIX + name: tensor for name, tensor in tensors.items()}


def _pooling(found: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """SigLIP's head that pools all patches into one feature, which nothing reads."""
    tower = "backbone.eagle_model.vision_model.vision_model."
    inner = found[f"{tower}encoder.layers.0.mlp.fc1.weight"]
    hidden, width = inner.shape
    shapes: dict[str, Sequence[int]] = {
        "probe": (1, 1, width),
        "attention.in_proj_weight": (3 * width, width),
        "attention.in_proj_bias": (3 * width,),
        "attention.out_proj.weight": (width, width),
        "attention.out_proj.bias": (width,),
        "layernorm.weight": (width,),
        "layernorm.bias": (width,),
        "mlp.fc1.weight": (hidden, width),
        "mlp.fc1.bias": (hidden,),
        "mlp.fc2.weight": (width, hidden),
        "mlp.fc2.bias": (width,),
    }
    return {
        f"{tower}head.{name}": torch.zeros(*shape, dtype=inner.dtype)
        for name, shape in shapes.items()
    }


def _arguments(kind: type, table: Mapping[str, Any]) -> dict[str, Any]:
    """All arguments of a part, with the defaults of those that its table leaves out."""
    parameters = inspect.signature(kind).parameters.values()
    return {p.name: table.get(p.name, p.default) for p in parameters if p.name != "context_dim"}


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, list | tuple) else value
