"""Checkpoints of LeRobot's ACT and Diffusion Policy (``--format lerobot``)."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from fluxvla_core.errors import CheckpointError
from fluxvla_core.models import CheckpointFormat, ForeignCheckpoint, renamed, safetensors_in
from fluxvla_core.results import read_json
from fluxvla_models.lerobot_files import (
    ACTION,
    CONFIG,
    STATE,
    check_policy_settings,
    policy_type,
)
from fluxvla_models.lerobot_names import act_name, diffusion_name
from fluxvla_models.lerobot_statistics import read_normalization, tables
from fluxvla_models.lerobot_write import write_act, write_diffusion

_ACT = (
    "feedforward_activation",
    "pre_norm",
    "n_encoder_layers",
    "n_decoder_layers",
    "use_vae",
    "latent_dim",
    "n_vae_encoder_layers",
    "dim_model",
    "n_heads",
    "dim_feedforward",
    "dropout",
    "kl_weight",
)
_DIFFUSION = (
    "horizon",
    "n_obs_steps",
    "crop_shape",
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
)
"""Settings that LeRobot and our models call the same."""


class _LeRobotFormat(CheckpointFormat):
    """Base class of the two formats; ``kind`` is the ``type`` in LeRobot's config."""

    name = "lerobot"
    kind: ClassVar[str]
    our_name: ClassVar[Callable[[str], str | None]]
    settings: ClassVar[Sequence[str]]
    """Its own names of settings in LeRobot's config."""

    @abstractmethod
    def model(self, config: Mapping[str, Any], where: str) -> dict[str, Any]:
        """The table of the model that LeRobot's ``config`` describes."""

    def notes(self, config: Mapping[str, Any]) -> Sequence[str]:
        """Notes that are printed when the checkpoint is imported."""
        used = config.get("n_action_steps")
        # A chunk begins with the actions of earlier observations.
        answered = self.horizon(config) - int(config.get("n_obs_steps", 1)) + 1
        if not isinstance(used, int) or used >= answered:
            return ()
        return (f"LeRobot executes {used} of {answered} actions: execute_horizon={used}",)

    @abstractmethod
    def horizon(self, config: Mapping[str, Any]) -> int:
        """Actions in a chunk."""

    def recognizes(self, folder: Path) -> bool:
        return policy_type(folder) == self.kind

    def read(self, folder: Path, tokenizer: str | None = None) -> ForeignCheckpoint:
        where = str(folder / CONFIG)
        config = read_json(folder / CONFIG, dict[str, Any], CheckpointError)
        check_policy_settings(config, self.settings, where)
        cameras, size = image_features(config, where)
        joints, dim = width(config, "input_features", STATE, where), action_dim(config, where)
        model = self.model(config, where)
        normalization = read_normalization(folder, config)
        transforms, statistics = tables(normalization, cameras, size, joints, dim)
        theirs = safetensors_in(folder)
        names = {ours: name for name in theirs if (ours := type(self).our_name(name)) is not None}
        weights = {name: theirs[name] for name in names.values()}
        seen = {policy: robot for robot, policy in (normalization.renamed or {}).items()}
        return ForeignCheckpoint(
            model=model,
            tensors=renamed(weights, names, str(folder)),
            img_keys=tuple(seen.get(name, name) for name in cameras),
            transforms=transforms,
            statistics=statistics,
            horizon=self.horizon(config),
            notes=self.notes(config),
        )


class LeRobotACT(_LeRobotFormat):
    """LeRobot's ``act``."""

    kind = "act"
    model_types = ("ACT",)
    settings = (
        *_ACT,
        "vision_backbone",
        "pretrained_backbone_weights",
        "replace_final_stride_with_dilation",
        "temporal_ensemble_coeff",
    )
    our_name = staticmethod(act_name)

    def write(self, checkpoint: ForeignCheckpoint, folder: Path) -> None:
        """Write it as LeRobot 0.6 saves a policy with its processors.

        Raises:
            CheckpointError: LeRobot's ACT or its processors cannot do what it does.
        """
        write_act(checkpoint, folder)

    def horizon(self, config: Mapping[str, Any]) -> int:
        return _count(config, "chunk_size")

    def notes(self, config: Mapping[str, Any]) -> Sequence[str]:
        coefficient = config.get("temporal_ensemble_coeff")
        if coefficient is None:
            return super().notes(config)
        return (
            "LeRobot averages chunks: chunk_joining=dict(method='temporal_ensemble', "
            f"coefficient={coefficient})",
        )

    def model(self, config: Mapping[str, Any], where: str) -> dict[str, Any]:
        _refuse(config, where, n_obs_steps=1, replace_final_stride_with_dilation=0)
        return {
            "type": "ACT",
            **_common(config, where),
            **_taken(config, _ACT, where),
            "horizon": _value(config, "chunk_size", where),
            "backbone_norm": "frozen_batch",
            "masked_mean": True,
        }


class LeRobotDiffusion(_LeRobotFormat):
    """LeRobot's ``diffusion``."""

    kind = "diffusion"
    model_types = ("DiffusionPolicy",)
    settings = (
        *_DIFFUSION,
        "drop_n_last_frames",
        "vision_backbone",
        "pretrained_backbone_weights",
        "resize_shape",
        "crop_ratio",
        "crop_is_random",
        "use_group_norm",
        "spatial_softmax_num_keypoints",
        "use_separate_rgb_encoder_per_camera",
        "clip_sample",
        "clip_sample_range",
        "do_mask_loss_for_padding",
    )
    our_name = staticmethod(diffusion_name)

    def write(self, checkpoint: ForeignCheckpoint, folder: Path) -> None:
        """Write it as LeRobot 0.6 saves a policy with its processors.

        Raises:
            CheckpointError: LeRobot's policy or its processors cannot do what it does.
        """
        write_diffusion(checkpoint, folder)

    def horizon(self, config: Mapping[str, Any]) -> int:
        return _count(config, "horizon")

    def model(self, config: Mapping[str, Any], where: str) -> dict[str, Any]:
        steps, horizon = _value(config, "n_obs_steps", where), self.horizon(config)
        if not isinstance(steps, int) or not 1 <= steps <= horizon:
            raise CheckpointError(
                f"n_obs_steps is {steps!r}, not a number from 1 to horizon {horizon}", where=where
            )
        clip = _value(config, "clip_sample_range", where)
        return {
            "type": "DiffusionPolicy",
            **_common(config, where),
            **_taken(config, _DIFFUSION, where),
            "resize_shape": config.get("resize_shape"),
            "backbone_norm": "group" if _value(config, "use_group_norm", where) else "batch",
            "separate_encoders": _value(config, "use_separate_rgb_encoder_per_camera", where),
            "keypoints": _value(config, "spatial_softmax_num_keypoints", where),
            "clip_sample_range": clip if _value(config, "clip_sample", where) else None,
            "masked_mean": bool(config.get("do_mask_loss_for_padding")),
        }


def features_of(
    config: Mapping[str, Any], section: str, where: str
) -> dict[str, tuple[str, tuple[int, ...]]]:
    """The policy's inputs or outputs: feature -> its type (``VISUAL``, ``STATE``, …) and shape.

    Raises:
        CheckpointError: the section is not what LeRobot writes.
    """
    found = _value(config, section, where)
    if not isinstance(found, dict):
        raise CheckpointError(f"{section} is no table", where=where)
    features: dict[str, tuple[str, tuple[int, ...]]] = {}
    for name, entry in found.items():
        shape = entry.get("shape") if isinstance(entry, dict) else None
        sizes = shape if isinstance(shape, list) else []
        if not sizes or not all(isinstance(n, int) and n > 0 for n in sizes):
            raise CheckpointError(f"{section}.{name} is {entry!r}, not a shape", where=where)
        features[name] = (str(entry.get("type")), tuple(sizes))
    return features


def image_features(config: Mapping[str, Any], where: str) -> tuple[list[str], tuple[int, int]]:
    """The policy's cameras, by feature, and the height and width of their images.

    Raises:
        CheckpointError: it has none, their sizes differ, or it takes what no robot has.
    """
    features = features_of(config, "input_features", where)
    found = {name: shape for name, (kind, shape) in features.items() if kind == "VISUAL"}
    sizes = set(found.values())
    if len(sizes) != 1 or any(len(shape) != 3 or shape[0] != 3 for shape in sizes):
        sizes = ", ".join(f"{name} {shape}" for name, shape in found.items()) or "none"
        raise CheckpointError(
            f"cameras with images of one size are expected, the policy has {sizes}", where=where
        )
    other = [name for name, (kind, _) in features.items() if kind not in ("VISUAL", "STATE")]
    if other:
        raise CheckpointError(f"the policy takes {other[0]}, which no robot has here", where=where)
    ((_, height, width_),) = sizes
    return list(found), (height, width_)


def width(config: Mapping[str, Any], section: str, feature: str, where: str) -> int:
    """The length of a feature's vector.

    Raises:
        CheckpointError: the policy has no such feature, or it is no vector.
    """
    features = features_of(config, section, where)
    if feature not in features:
        raise CheckpointError(
            f"{section} has no {feature}; it has {', '.join(features) or 'nothing'}", where=where
        )
    shape = features[feature][1]
    if len(shape) != 1:
        raise CheckpointError(f"{feature} is {shape}, a vector is expected", where=where)
    return shape[0]


def action_dim(config: Mapping[str, Any], where: str) -> int:
    """The length of an action."""
    return width(config, "output_features", ACTION, where)


def _common(config: Mapping[str, Any], where: str) -> dict[str, Any]:
    return {
        "state_dim": width(config, "input_features", STATE, where),
        "action_dim": action_dim(config, where),
        "num_cameras": len(image_features(config, where)[0]),
        "backbone": _value(config, "vision_backbone", where),
    }


def _taken(config: Mapping[str, Any], names: Sequence[str], where: str) -> dict[str, Any]:
    return {name: _value(config, name, where) for name in names}


def _value(config: Mapping[str, Any], name: str, where: str) -> Any:
    if name not in config:
        raise CheckpointError(
            f"there is no {name!r}", where=where, cause="it was saved by another version of LeRobot"
        )
    return config[name]


def _count(config: Mapping[str, Any], name: str) -> int:
    found = config.get(name)
    if not isinstance(found, int) or found < 1:
        raise CheckpointError(f"{name} is {found!r}, no number of actions", where=CONFIG)
    return found


def _refuse(config: Mapping[str, Any], where: str, **only: object) -> None:
    for name, value in only.items():
        if config.get(name, value) != value:
            raise CheckpointError(
                f"{name} is {config[name]!r}, only {value!r} is built here", where=where
            )
