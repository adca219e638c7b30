"""Reads PI0 and PI0.5 as LeRobot saves them: ``config.json``, weights, its processors' files."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from fluxvla_models.lerobot_files import (
    ACTION,
    BUFFERS,
    CONFIG,
    PREPROCESSOR,
    STATE,
    check_policy_settings,
    policy_type,
)

from fluxvla_core.errors import CheckpointError
from fluxvla_core.models import (
    CheckpointFormat,
    ForeignCheckpoint,
    safetensors_in,
    without_cameras,
)
from fluxvla_core.results import read_json
from fluxvla_pi.lerobot_processors import (
    KEYS,
    Preparation,
    from_buffers,
    from_files,
)
from fluxvla_pi.lerobot_write import IMAGES, write_pi
from fluxvla_pi.published import (
    FAMILIES,
    weights_in,
)

_EMPTY = f"{IMAGES}empty_camera_"
_FIXED = {
    "n_obs_steps": 1,
    "min_period": 4e-3,
    "max_period": 4.0,
    "use_peft": False,
    # Before LeRobot 0.4:
    "num_steps": 10,
    "resize_imgs_with_padding": [224, 224],
    "adapt_to_pi_aloha": False,
    "use_delta_joint_actions_aloha": False,
}
SHARED = (
    "paligemma_variant",
    "action_expert_variant",
    "dtype",
    "max_state_dim",
    "max_action_dim",
    "use_relative_actions",
    "relative_exclude_joints",
    "action_feature_names",
    "rtc_config",
    "image_resolution",
    "empty_cameras",
    "tokenizer_max_length",
)
"""Names of settings in LeRobot's config of PI0, PI0.5 and PI0-FAST."""
SETTINGS = (
    *SHARED,
    *_FIXED,
    "num_inference_steps",
    "proj_width",
    "use_cache",
    "attention_implementation",
)
"""Those of PI0 and PI0.5; the last three from before LeRobot 0.4."""


class LeRobotPiFormat(CheckpointFormat):
    """LeRobot's ``pi0`` and ``pi05`` policies."""

    name: ClassVar[str] = "lerobot"
    model_types: ClassVar[Sequence[str]] = tuple(kind.__name__ for kind in FAMILIES.values())

    def recognizes(self, folder: Path) -> bool:
        """Whether ``config.json`` is of such a policy."""
        return policy_type(folder) in FAMILIES

    def read(
        self, folder: Path, tokenizer: str | None = None, absent: Sequence[str] = ()
    ) -> ForeignCheckpoint:
        """The checkpoint in ``folder``.

        Args:
            tokenizer: the folder of PaliGemma's tokenizer.
            absent: cameras without images, which LeRobot masks.

        Raises:
            CheckpointError: it is damaged, or does something that PI0 here does not.
            UsageError: it has no such camera.
        """
        where = str(folder / CONFIG)
        config = read_json(folder / CONFIG, dict[str, Any], CheckpointError)
        for key, value in _FIXED.items():
            if config.get(key, value) != value:
                raise CheckpointError(f"{key} is {config[key]!r}; {value!r} is read", where=where)
        check_policy_settings(config, SETTINGS, where)
        family = config["type"]
        inputs, outputs = (
            features_of(config, f"{way}_features", where) for way in ("input", "output")
        )
        old = [name for name in safetensors_in(folder) if name.startswith(BUFFERS)]
        weights = weights_in(folder, old)
        if weights.family != family:
            raise CheckpointError(
                f"type is {family}, the weights are those of {weights.family}", where=where
            )
        widths = {
            STATE: width_of(inputs, STATE, where),
            ACTION: width_of(outputs, ACTION, where),
        }
        default = 48 if family == "pi0" else 200
        max_length = count_of(config, "tokenizer_max_length", default, where)
        if os.path.lexists(folder / f"{PREPROCESSOR}.json"):
            preparation = from_files(folder, widths)
        else:
            preparation = from_buffers(folder, config, widths, max_length)
        cameras = cameras_in(inputs, where, preparation.renamed)
        horizon = count_of(config, "chunk_size", 50, where)
        model = {
            **weights.model,
            "n_action_steps": horizon,
            "num_steps": count_of(config, "num_inference_steps", 10, where),
            "ori_action_dim": widths[ACTION],
        }
        size = resolution_of(config, where)
        return ForeignCheckpoint(
            model=model,
            tensors=weights.tensors,
            img_keys=without_cameras(cameras, absent, where),
            transforms=_transforms(model, preparation, size, tokenizer),
            statistics={"private": statistics_of(preparation, widths)},
            horizon=horizon,
            notes=notes_of(
                preparation, tokenizer, count_of(config, "n_action_steps", horizon, where), horizon
            ),
        )

    def write(self, checkpoint: ForeignCheckpoint, folder: Path) -> None:
        """Write ``checkpoint`` into ``folder``; see ``CheckpointFormat``."""
        write_pi(checkpoint, folder)


def resolution_of(config: Mapping[str, Any], where: str) -> list[int]:
    """Height and width that images are brought to."""
    size = config.get("image_resolution", [224, 224])
    if not isinstance(size, list) or len(size) != 2 or not all(type(n) is int for n in size):
        raise CheckpointError(f"image_resolution is {size!r}, not two numbers", where=where)
    return size


def count_of(config: Mapping[str, Any], key: str, default: int, where: str) -> int:
    """A setting that is a number from 1."""
    value = config.get(key, default)
    if not isinstance(value, int) or value < 1:
        raise CheckpointError(f"{key} is {value!r}, not a number from 1", where=where)
    return value


def features_of(config: Mapping[str, Any], key: str, where: str) -> dict[str, dict[str, Any]]:
    """``input_features`` or ``output_features``."""
    features = config.get(key)
    if not isinstance(features, dict) or not all(isinstance(f, dict) for f in features.values()):
        raise CheckpointError(f"{key} is no table of features", where=where)
    return features


def width_of(features: Mapping[str, Mapping[str, Any]], key: str, where: str) -> int:
    """The width of a feature that is a row of numbers."""
    shape = features.get(key, {}).get("shape")
    if not isinstance(shape, list) or len(shape) != 1 or not isinstance(shape[0], int):
        raise CheckpointError(f"the feature {key!r} has no shape of one number", where=where)
    return shape[0]


def cameras_in(
    features: Mapping[str, Mapping[str, Any]], where: str, renamed: Mapping[str, str]
) -> list[str]:
    """Cameras in the model's order, without those that are never there: they are masked.

    Args:
        renamed: the robot's name of an observation -> the policy's; the robot's is returned.
    """
    robots = {theirs: ours for ours, theirs in renamed.items()}
    found = [
        robots.get(key, key)
        for key, feature in features.items()
        if feature.get("type") == "VISUAL" and not key.startswith(_EMPTY)
    ]
    if not found:
        raise CheckpointError("input_features: there is no camera", where=where)
    return found


def _transforms(
    model: Mapping[str, Any],
    preparation: Preparation,
    size: Sequence[int],
    tokenizer: str | None,
) -> list[dict[str, Any]]:
    numbers = {**normalization(preparation), "action_dim": model["max_action_dim"]}
    if "max_state_dim" in model:
        numbers["state_dim"] = model["max_state_dim"]
        prompt: dict[str, Any] = {"type": "PreparePrompt", "clean": False}
    else:
        prompt = {"type": "PreparePromptWithState"}
    return [*of_images(size), numbers, prompt, of_words(preparation, tokenizer)]


def of_images(size: Sequence[int]) -> list[dict[str, Any]]:
    """The transforms that bring images to ``size``, height and width."""
    height, width = size
    resize = {"type": "ResizeImagesWithPad", "height": height, "width": width}
    return [{**resize, "interpolation": "linear"}, {"type": "SimpleNormalizeImages"}]


def normalization(preparation: Preparation) -> dict[str, Any]:
    """The transform that normalises, without widths that it pads to."""
    return {
        "type": "NormalizeStatesAndActions",
        "norm_type": preparation.modes[ACTION],
        "state_norm_type": preparation.modes[STATE],
        "epsilon": preparation.epsilon,
        "epsilon_if_zero": preparation.epsilon_if_zero,
    }


def of_words(preparation: Preparation, tokenizer: str | None) -> dict[str, Any]:
    """The transform that makes tokens of the prompt."""
    path = tokenizer or preparation.tokenizer
    return {
        "type": "ProcessPrompts",
        "tokenizer": {"type": "PretrainedTokenizer", "model_path": path},
        "max_len": preparation.max_length,
    }


def statistics_of(preparation: Preparation, widths: Mapping[str, int]) -> dict[str, Any]:
    """Of each of our entries, but for those that a base model has not; zeros and ones where nothing
    is normalised."""
    found: dict[str, Any] = {}
    for key, entry in KEYS.items():
        rows = dict(preparation.statistics.get(key, {}))
        if preparation.modes[key] == "none":
            rows = {"mean": [0.0] * widths[key], "std": [1.0] * widths[key]}
        elif not rows:
            continue
        elif "mean" not in rows:
            low, high = (rows[name] for name in list(rows)[:2])
            rows["mean"] = [(a + b) / 2 for a, b in zip(low, high, strict=True)]
        found[entry] = {name: list(row) for name, row in rows.items()}
    if preparation.relative is not None and "action" in found:
        found["action"]["relative"] = [float(counted) for counted in preparation.relative]
    return found


def notes_of(
    preparation: Preparation, tokenizer: str | None, executed: int, horizon: int
) -> list[str]:
    """What a user should know of the import.

    Args:
        executed: actions of a chunk that LeRobot executes, of ``horizon``.
    """
    notes = []
    if executed < horizon:
        notes.append(f"LeRobot executes {executed} of its {horizon} actions: execute_horizon")
    none = [
        key
        for key in KEYS
        if preparation.modes[key] != "none" and not preparation.statistics.get(key)
    ]
    if none:
        notes.append(
            f"there are no statistics of {', '.join(none)}: it is a base model, to be fine-tuned; "
            "it drives no robot"
        )
    if tokenizer is None:
        notes.append(
            f"its tokenizer is {preparation.tokenizer}; --tokenizer names the folder that has it"
        )
    return notes
