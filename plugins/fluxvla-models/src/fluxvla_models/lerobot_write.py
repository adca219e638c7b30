"""Writing ACT and Diffusion Policy as LeRobot 0.6 saves them: config, weights and processors.

LeRobot's policies take images as cameras give them and normalise each camera by itself; what it
cannot say, such as resizing before the policy, is refused rather than lost.
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
from safetensors.torch import save_file
from torch import Tensor

from fluxvla_core import build_transform_from_cfg
from fluxvla_core.data import make_affine
from fluxvla_core.errors import CheckpointError
from fluxvla_core.models import ForeignCheckpoint
from fluxvla_models.act import ACT
from fluxvla_models.diffusion_policy import DiffusionPolicy
from fluxvla_models.keypoint_encoder import position_grid
from fluxvla_models.lerobot_files import (
    ACTION,
    CONFIG,
    EPS,
    POSTPROCESSOR,
    PREPROCESSOR,
    STATE,
    full_tensor,
    write_steps,
)
from fluxvla_models.lerobot_names import published_act_name, published_diffusion_name
from fluxvla_models.transformer import positions_1d

Floats = npt.NDArray[np.float64]
_STRIDE = 32
"""Stride of a ResNet: pixels of the image for one of its last feature map."""
_RANGES = {"min_max": ("MIN_MAX", "min", "max"), "quantile": ("QUANTILES", "q01", "q99")}
"""``norm_type`` of a range -> LeRobot's mode and the names of its ends."""
_DEVICE = ("device_processor", {"device": "cpu", "float_dtype": None}, {})


@dataclass(frozen=True)
class Preparation:
    """What LeRobot's processors have to do for the policy.

    Args:
        features: ``input_features`` and ``output_features``: name -> type and shape.
        modes: ``VISUAL``, ``STATE``, ``ACTION`` -> how it is normalised.
        statistics: ``<feature>.<statistic>`` -> numbers.
        size: height and width of images.
    """

    features: Mapping[str, Mapping[str, Any]]
    modes: Mapping[str, str]
    statistics: Mapping[str, Tensor]
    size: tuple[int, int]

    @property
    def inputs(self) -> dict[str, Any]:
        """Input features of the policy."""
        return {name: entry for name, entry in self.features.items() if name != ACTION}


def write_act(checkpoint: ForeignCheckpoint, folder: Path) -> None:
    """Write an ``ACT`` into the empty ``folder``; weights keep their dtype.

    Raises:
        CheckpointError: LeRobot's ACT or its processors cannot do what it does.
    """
    model = _settings(ACT, checkpoint.model)
    _only(model, "LeRobot's ACT", backbone_norm="frozen_batch", backbone_width=64)
    prepared = _preparation(checkpoint, model)
    config = {
        "chunk_size": model["horizon"],
        "n_action_steps": model["horizon"],
        "replace_final_stride_with_dilation": False,
        "temporal_ensemble_coeff": None,
        **_same(
            model,
            "pre_norm",
            "dim_model",
            "n_heads",
            "dim_feedforward",
            "feedforward_activation",
            "n_encoder_layers",
            "n_decoder_layers",
            "use_vae",
            "latent_dim",
            "n_vae_encoder_layers",
            "dropout",
            "kl_weight",
        ),
    }
    tensors = {published_act_name(name): full_tensor(t) for name, t in checkpoint.tensors.items()}
    if model["use_vae"]:  # the place of the class token, the state and each action
        table = positions_1d(model["horizon"] + 2, model["dim_model"], torch.device("cpu"))
        tensors["model.vae_encoder_pos_enc"] = table
    _write(folder, "act", model, config, prepared, tensors)


def write_diffusion(checkpoint: ForeignCheckpoint, folder: Path) -> None:
    """Write a ``DiffusionPolicy`` into the empty ``folder``; weights keep their dtype.

    Raises:
        CheckpointError: LeRobot's diffusion policy or its processors cannot do what it does.
    """
    model = _settings(DiffusionPolicy, checkpoint.model)
    _only(model, "LeRobot's diffusion policy", backbone_width=64)
    if model["backbone_norm"] == "frozen_batch":
        raise CheckpointError("backbone_norm is 'frozen_batch'; LeRobot's are 'batch' and 'group'")
    prepared = _preparation(checkpoint, model)
    clip = model["clip_sample_range"]
    config = {
        "n_obs_steps": model["n_obs_steps"],
        "n_action_steps": model["horizon"] - model["n_obs_steps"] + 1,
        **_crop(model["resize_shape"], model["crop_shape"]),
        "use_group_norm": model["backbone_norm"] == "group",
        "spatial_softmax_num_keypoints": model["keypoints"],
        "use_separate_rgb_encoder_per_camera": model["separate_encoders"],
        "clip_sample": clip is not None,
        "clip_sample_range": 1.0 if clip is None else clip,
        "do_mask_loss_for_padding": model["masked_mean"],
        **_same(
            model,
            "horizon",
            "down_dims",
            "kernel_size",
            "n_groups",
            "diffusion_step_embed_dim",
            "use_film_scale_modulation",
            "noise_scheduler_type",
            "num_train_timesteps",
            "num_inference_steps",
            "beta_schedule",
            "beta_start",
            "beta_end",
            "prediction_type",
        ),
    }
    separate = bool(model["separate_encoders"])
    tensors = {
        published_diffusion_name(name, separate): full_tensor(t)
        for name, t in checkpoint.tensors.items()
    }
    seen = model["crop_shape"] or model["resize_shape"] or prepared.size
    grid = position_grid(*(-(-int(side) // _STRIDE) for side in seen))
    encoders = [f".{i}" for i in range(model["num_cameras"])] if separate else [""]
    tensors |= {f"diffusion.rgb_encoder{place}.pool.pos_grid": grid.clone() for place in encoders}
    _write(folder, "diffusion", model, config, prepared, tensors)


def _write(
    folder: Path,
    kind: str,
    model: Mapping[str, Any],
    more: Mapping[str, Any],
    prepared: Preparation,
    tensors: Mapping[str, Tensor],
) -> None:
    config = {
        "type": kind,
        "n_obs_steps": 1,
        "input_features": prepared.inputs,
        "output_features": {ACTION: prepared.features[ACTION]},
        "device": "cpu",
        "normalization_mapping": prepared.modes,
        "vision_backbone": model["backbone"],
        "pretrained_backbone_weights": None,
        **more,
    }
    (folder / CONFIG).write_text(json.dumps(config, indent=4) + "\n", encoding="utf-8")
    contiguous = {name: tensor.contiguous() for name, tensor in tensors.items()}
    save_file(contiguous, folder / "model.safetensors", {"format": "pt"})
    norms = {"eps": EPS, "norm_map": dict(prepared.modes)}
    statistics = dict(prepared.statistics)
    before = [
        ("rename_observations_processor", {"rename_map": {}}, {}),
        ("to_batch_processor", {}, {}),
        _DEVICE,
        ("normalizer_processor", {**norms, "features": dict(prepared.features)}, statistics),
    ]
    outputs = {ACTION: prepared.features[ACTION]}
    after = [("unnormalizer_processor", {**norms, "features": outputs}, statistics), _DEVICE]
    write_steps(folder, PREPROCESSOR, before)
    write_steps(folder, POSTPROCESSOR, after)


def _preparation(checkpoint: ForeignCheckpoint, model: Mapping[str, Any]) -> Preparation:
    tables = _acting(checkpoint.transforms)
    size = _size(checkpoint, tables.pop("ResizeImages", None))
    numbers = tables.pop("NormalizeStatesAndActions", None)
    images = next((tables.pop(n) for n in _NORMALIZE_IMAGES if n in tables), None)
    if numbers is None or images is None or tables:
        what = f"{next(iter(tables))} is" if tables else "a normalisation is not"
        raise CheckpointError(
            f"{what} among the transforms; LeRobot's processors only normalise: images, states "
            "and actions",
            next="train with ResizeImages, NormalizeImages and NormalizeStatesAndActions",
        )
    statistics: dict[str, Tensor] = {}
    features: dict[str, dict[str, Any]] = {}
    modes = {"VISUAL": "MEAN_STD"}
    entries = checkpoint.statistics.get("private", {})
    for feature, kind, key, norm_type, width in (
        (
            STATE,
            "STATE",
            numbers.get("state_key", "proprio"),
            numbers.get("state_norm_type"),
            model["state_dim"],
        ),
        (ACTION, "ACTION", numbers.get("action_key", "action"), None, model["action_dim"]),
    ):
        if not entries.get(key):
            raise CheckpointError(
                f"the checkpoint has no statistics of {key!r}: LeRobot's would not act"
            )
        rows, modes[kind] = _numbers(entries[key], numbers, norm_type, feature, width)
        features[feature] = {"type": kind, "shape": [width]}
        statistics |= {f"{feature}.{name}": _float(row) for name, row in rows.items()}
        if feature == STATE:  # LeRobot has images between the two
            for name, (mean, std) in zip(
                checkpoint.img_keys, _scales(images, len(checkpoint.img_keys)), strict=True
            ):
                camera = name if name.startswith("observation.") else f"observation.images.{name}"
                features[camera] = {"type": "VISUAL", "shape": [3, *size]}
                statistics[f"{camera}.mean"] = _float(mean).reshape(3, 1, 1)
                statistics[f"{camera}.std"] = _float(std - EPS).reshape(3, 1, 1)
    return Preparation(features, modes, statistics, size)


_NORMALIZE_IMAGES = ("NormalizeImages", "SimpleNormalizeImages")


def _acting(tables: Sequence[Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    """The transforms that a policy acts with, by name; those of training alone do not matter."""
    named = ((str(table["type"]).rpartition(":")[2], table) for table in tables)
    known = ("ResizeImages", *_NORMALIZE_IMAGES, "NormalizeStatesAndActions")
    return {
        name: table
        for name, table in named
        if name in known or not build_transform_from_cfg(dict(table)).training_only
    }


def _size(checkpoint: ForeignCheckpoint, resize: Mapping[str, Any] | None) -> tuple[int, int]:
    """Height and width of images, which LeRobot takes as the cameras give them."""
    robot = checkpoint.embodiment
    used = (
        [camera for camera in robot.cameras if camera.name in checkpoint.img_keys] if robot else []
    )
    sizes = {(camera.height, camera.width) for camera in used}
    if resize is not None:
        sizes.add((int(resize["height"]), int(resize["width"])))
    if len(sizes) != 1:
        listed = ", ".join(f"{height} x {width}" for height, width in sorted(sizes)) or "none"
        raise CheckpointError(
            f"LeRobot's policy takes images of one size as its cameras give them; cameras and "
            f"ResizeImages have {listed}",
            next="record and train with images of the size that the policy sees",
        )
    return sizes.pop()


def _scales(table: Mapping[str, Any], cameras: int) -> list[tuple[Floats, Floats]]:
    """Offset and scale, each ``(3,)``, of each camera's images in 0..1."""
    if str(table["type"]).endswith("SimpleNormalizeImages"):
        return [(np.full(3, 0.5), np.full(3, 0.5))] * cameras
    means, stds = (np.asarray(table[name], np.float64).reshape(-1, 3) for name in ("means", "stds"))
    unit = 1.0 if table.get("scale_to_unit_interval") else 255.0
    found = [(m / unit, (s + EPS) / unit) for m, s in zip(means, stds, strict=True)]
    return found * cameras if len(found) == 1 else found


def _numbers(
    entry: Mapping[str, Any],
    table: Mapping[str, Any],
    norm_type: str | None,
    feature: str,
    width: int,
) -> tuple[dict[str, Floats], str]:
    """Statistics that LeRobot normalises a feature by, and its mode."""
    who = "NormalizeStatesAndActions"
    action = feature == ACTION
    norm = norm_type or table.get("norm_type", "mean_std")
    affine = make_affine(
        entry,
        norm,
        who,
        table.get("std_floor", 0.0),
        table.get("action_norm_mask") if action else None,
        table.get("epsilon", 1e-6),
        table.get("epsilon_if_zero", False),
    )
    if action and affine.relative is not None:
        raise CheckpointError(
            "actions are counted from the state, which LeRobot's policies of this kind cannot say"
        )
    if affine.offset.shape != (width,):
        raise CheckpointError(
            f"the statistics of {feature} have shape {affine.offset.shape}; LeRobot's policy takes "
            f"{width} numbers, the model's"
        )
    mask = table.get("action_norm_mask") if action else None
    plain = not table.get("std_floor", 0.0) and (mask is None or all(mask))
    mode, low, high = _RANGES.get(norm, ("", "", ""))
    if mode and plain:
        # What never moves stays at -1, which a mean of 32 bits and a minute std would not give.
        added = 0.0 if table.get("epsilon_if_zero") else table.get("epsilon", 1e-6)
        ends = {name: np.asarray(entry[name], np.float64) for name in (low, high)}
        return {low: ends[low], high: ends[high] + added}, mode
    ranges = {name: np.asarray(entry[name], np.float64) for name in ("min", "max") if name in entry}
    return {"mean": affine.offset, "std": affine.scale - EPS, **ranges}, "MEAN_STD"


def _crop(resize: Sequence[int] | None, crop: Sequence[int] | None) -> dict[str, Any]:
    """LeRobot's settings: where images are resized first, the crop is a share of their sides."""
    if resize is None or crop is None:
        return {
            "resize_shape": None if resize is None else list(resize),
            "crop_ratio": 1.0,
            "crop_shape": None if crop is None else list(crop),
        }
    low = max(c / side for c, side in zip(crop, resize, strict=True))
    high = min((c + 1) / side for c, side in zip(crop, resize, strict=True))
    tried = (round((low + high) / 2, digits) for digits in range(1, 16))
    sizes = list(crop)
    for ratio in tried:
        if 0 < ratio < 1 and [int(side * ratio) for side in resize] == sizes:
            return {"resize_shape": list(resize), "crop_ratio": ratio, "crop_shape": sizes}
    raise CheckpointError(
        f"crop_shape {tuple(crop)} is not the same share of both sides of resize_shape "
        f"{tuple(resize)}, as LeRobot has it"
    )


def _settings(kind: type, table: Mapping[str, Any]) -> dict[str, Any]:
    """The model's arguments, with the defaults of those that the config leaves out."""
    parameters = inspect.signature(kind).parameters.values()
    return {p.name: table.get(p.name, p.default) for p in parameters}


def _same(model: Mapping[str, Any], *names: str) -> dict[str, Any]:
    return {name: model[name] for name in names}


def _only(model: Mapping[str, Any], whose: str, **wanted: Any) -> None:
    for name, value in wanted.items():
        if model[name] != value:
            raise CheckpointError(
                f"{name} is {model[name]!r}; {whose} has {value!r}",
                next=f"train with {name}={value!r}",
            )


def _float(values: Floats) -> Tensor:
    return torch.tensor(values, dtype=torch.float32)
