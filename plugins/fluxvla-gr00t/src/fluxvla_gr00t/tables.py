"""Published checkpoints as tables of model and transforms, weights and statistics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from fluxvla_core import build_vla_from_cfg
from fluxvla_core.errors import CheckpointError
from fluxvla_core.models import ForeignCheckpoint, Stored, renamed
from fluxvla_gr00t.names import is_unread, published_name
from fluxvla_gr00t.robots import Robot

BACKBONES: dict[str, dict[str, Any]] = {
    "n1.5": {"type": "EagleBackbone"},
    "n1.7": {"type": "Qwen3VLBackbone"},
}
"""The backbones, whose sizes no file says."""
TOKENIZERS = {
    "n1.5": "lerobot/eagle2hg-processor-groot-n1p5",
    "n1.7": "nvidia/Cosmos-Reason2-2B",
}
"""Where the tokenizers are published; the checkpoints have none."""
_WORDS = 132
"""Tokens of a prompt besides image tokens: 900 in all for three images."""


def model_table(
    version: str, head: Mapping[str, Any], robot: Robot, text_layers: int | None = None
) -> dict[str, Any]:
    """The config's ``model``; ``text_layers`` None: as many as were published."""
    backbone = dict(BACKBONES[version])
    if text_layers is not None:
        backbone["text_layers"] = text_layers
    actions = robot.statistics.get("action")
    own = {} if actions is None else {"ori_action_dim": _width(actions["mean"])}
    return {
        "type": "GR00T",
        "vlm_backbone": backbone,
        "vla_head": {**head, **own},
        "embodiment_id": robot.embodiment_id,
    }


def n15_transforms(
    model: Mapping[str, Any], robot: Robot, tokenizer: str | None
) -> list[dict[str, Any]]:
    """From an observation to what N1.5 takes."""
    count = len(robot.img_keys)
    side = int(model["vlm_backbone"].get("image_size", 224))
    tokens_per_image = (side // int(model["vlm_backbone"].get("patch_size", 14))) ** 2
    return [
        {"type": "ListInstruction"},
        {
            "type": "ProcessPromptsWithImage",
            "max_len": count * tokens_per_image + _WORDS,
            "num_images": count,
            "fixed_img_tokens": tokens_per_image,
            "tokenizer": _tokenizer("n1.5", tokenizer),
        },
        {"type": "ResizeImages", "height": side, "width": side},
        {"type": "SimpleNormalizeImages"},
        _normalize(model, robot),
    ]


def n17_transforms(
    model: Mapping[str, Any],
    robot: Robot,
    tokenizer: str | None,
    resize: Mapping[str, Any],
    formalize: bool,
    clip: bool,
) -> list[dict[str, Any]]:
    """From an observation to what N1.7 takes; ``resize`` is what ``resize_table`` gave."""
    tokens_per_image = (int(resize["size"]) // 32) ** 2
    return [
        dict(resize),
        {
            "type": "ProcessQwenPrompts",
            # Images that keep their aspect ratio take more tokens than square ones.
            "max_len": len(robot.img_keys) * 2 * tokens_per_image + _WORDS,
            "formalize": formalize,
            "tokenizer": _tokenizer("n1.7", tokenizer),
        },
        {"type": "SimpleNormalizeImages"},
        _normalize(model, robot),
        *([{"type": "ClipNormalized"}] if clip else []),
    ]


def resize_table(settings: Mapping[str, Any], where: str) -> dict[str, Any]:
    """The transform of images, by N1.7's settings, which ``where`` has.

    Raises:
        CheckpointError: images are not square.
    """
    sizes = []
    for name in ("image_target_size", "image_crop_size"):
        value = settings.get(name)
        if value is not None and (len(value) != 2 or value[0] != value[1]):
            raise CheckpointError(f"{name} {value} is not square", where=where)
        sizes.append(value)
    target, crop = sizes
    size = 256 if target is None else int(target[0])
    fraction = settings.get("crop_fraction")
    if fraction is None:
        fraction = 1.0 if crop is None else crop[0] / size
    return {
        "type": "ResizeCropImages",
        "size": size,
        "shortest_edge": settings.get("shortest_image_edge"),
        "crop_fraction": float(fraction),
        "method": "area" if settings.get("use_albumentations") else "bicubic",
        "letter_box": bool(settings.get("letter_box_transform", False)),
    }


def checkpoint(
    version: str,
    stored: Mapping[str, Stored],
    model: Mapping[str, Any],
    transforms: Sequence[Mapping[str, Any]],
    robot: Robot,
    where: str,
) -> ForeignCheckpoint:
    """All of it.

    Args:
        stored: the tensors by their published names.
        where: the folder, for messages.

    Raises:
        CheckpointError: tensors are missing, or not the model's.
    """
    horizon = int(model["vla_head"]["horizon"])
    notes = list(robot.notes)
    if robot.horizon is not None and robot.horizon < horizon:
        notes.append(
            f"of the {horizon} actions of a chunk {robot.horizon} were trained: execute no more"
        )
    for key, dim in (("proprio", "state_dim"), ("action", "action_dim")):
        width = _width(robot.statistics[key]["mean"]) if key in robot.statistics else 0
        if width > int(model["vla_head"][dim]):
            raise CheckpointError(
                f"the statistics of {key!r} have {width} dimensions, {dim} of the model is "
                f"{model['vla_head'][dim]}",
                where=where,
                cause="the statistics are of another robot or model",
            )
    statistics = {key: _padded(entry, horizon) for key, entry in robot.statistics.items()}
    with torch.device("meta"):
        own = build_vla_from_cfg(model).state_dict()
    read = {name: stored[name] for name in stored if not is_unread(name, version)}
    return ForeignCheckpoint(
        model=model,
        tensors=renamed(read, {name: published_name(name, version) for name in own}, where),
        img_keys=robot.img_keys,
        transforms=transforms if statistics else (),
        statistics={"private": statistics},
        horizon=horizon,
        action_rate_hz=robot.rate,
        notes=tuple(notes),
    )


def _padded(entry: Mapping[str, list[Any]], horizon: int) -> dict[str, list[Any]]:
    """Statistics of one row a step, as long as a chunk: the last row is repeated."""
    return {
        name: values + [values[-1]] * (horizon - len(values))
        if values and isinstance(values[0], list)
        else values
        for name, values in entry.items()
    }


def _width(values: list[Any]) -> int:
    return len(values[0]) if isinstance(values[0], list) else len(values)


def _tokenizer(version: str, place: str | None) -> dict[str, Any]:
    return {"type": "PretrainedTokenizer", "model_path": place or TOKENIZERS[version]}


def _normalize(model: Mapping[str, Any], robot: Robot) -> dict[str, Any]:
    return {
        "type": "NormalizeStatesAndActions",
        "state_dim": model["vla_head"]["state_dim"],
        "action_dim": model["vla_head"]["action_dim"],
        "norm_type": robot.norm_type,
        "epsilon_if_zero": True,
    }
