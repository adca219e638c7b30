"""PI0 and PI0.5 as LeRobot saves them: ``config.json``, weights, and its processors' files."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import torch
from fluxvla_models.lerobot_files import (
    ACTION,
    BUFFERS,
    CONFIG,
    PREPROCESSOR,
    STATE,
    check_policy_settings,
    policy_type,
)
from safetensors.torch import save_file

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
    MODES,
    STATISTICS,
    TOKENIZER,
    Preparation,
    from_buffers,
    from_files,
    write_processors,
)
from fluxvla_pi.names import LEROBOT
from fluxvla_pi.published import (
    FAMILIES,
    action_names,
    family_of,
    only,
    table_of,
    weights_in,
    weights_to_write,
)

IMAGES = "observation.images."
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
        family = family_of(checkpoint)
        _check_sizes(checkpoint)
        if family == "pi0":
            only(table_of(checkpoint, "PreparePrompt"), "clean", False, True)
        else:
            only(table_of(checkpoint, "PreparePromptWithState"), "state_dim", None, None)
        model = checkpoint.model
        more = {
            "action_expert_variant": "gemma_300m",
            "max_action_dim": model.get("max_action_dim", 32),
            "num_inference_steps": model.get("num_steps", 10),
        }
        if family == "pi0":
            more["max_state_dim"] = model.get("max_state_dim", 32)
        write_policy(checkpoint, family, more, folder)


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


# -- writing ---------------------------------------------------------------------------------


def write_policy(
    checkpoint: ForeignCheckpoint,
    family: str,
    more: Mapping[str, Any],
    folder: Path,
    action_tokens: Mapping[str, Any] | None = None,
) -> None:
    """Write config, weights and processors into the empty ``folder``.

    Args:
        family: LeRobot's ``type`` of the policy.
        more: settings of its config besides those of every family.
        action_tokens: as of ``write_processors``.

    Raises:
        CheckpointError: LeRobot's processors cannot prepare observations as they are here.
    """
    preparation = _preparation(checkpoint)
    tensors = weights_to_write(checkpoint, LEROBOT)
    # By a matrix: LeRobot keeps the weights of normalisations in float32 beside bf16.
    matrix = LEROBOT.theirs("llm_backbone.layers.0.self_attn.q_proj.weight")
    narrow = tensors[matrix].dtype == torch.bfloat16
    config = {
        **_config(checkpoint, family, preparation),
        **more,
        "dtype": "bfloat16" if narrow else "float32",
    }
    features = {**config["input_features"], **config["output_features"]}
    names = action_names(checkpoint)
    write_processors(folder, family, features, preparation, names, action_tokens)
    save_file(tensors, folder / "model.safetensors", {"format": "pt"})
    (folder / CONFIG).write_text(json.dumps(config, indent=4) + "\n", encoding="utf-8")


def _check_sizes(checkpoint: ForeignCheckpoint) -> None:
    model = checkpoint.model
    sizes = {key: model.get(key, default) for key, default in _VARIANTS.items()}
    if sizes != _VARIANTS or model.get("vocab_size", 257152) != VOCABULARY:
        raise CheckpointError(
            f"LeRobot's policies have the sizes {', '.join(_VARIANTS.values())}; this one has "
            f"{', '.join(map(str, sizes.values()))}",
            next="--format openpi writes any size",
        )


def _config(checkpoint: ForeignCheckpoint, family: str, preparation: Preparation) -> dict[str, Any]:
    """What the config of every family has."""
    resize = table_of(checkpoint, "ResizeImagesWithPad")
    only(resize, "interpolation", "linear", "antialias")
    size = [int(resize["height"]), int(resize["width"])]
    robot = checkpoint.embodiment
    seen = {} if robot is None else {c.name: [c.height, c.width] for c in robot.cameras}
    inputs: dict[str, Any] = {
        IMAGES + name: {"type": "VISUAL", "shape": [3, *seen.get(name, size)]}
        for name in checkpoint.img_keys
    }
    entries = checkpoint.statistics["private"]
    widths = {key: len(entries[entry]["mean"]) for key, entry in KEYS.items()}
    inputs[STATE] = {"type": "STATE", "shape": [widths[STATE]]}
    theirs = {ours: mode for mode, ours in MODES.items()}
    names = action_names(checkpoint)
    config: dict[str, Any] = {
        "type": family,
        "n_obs_steps": 1,
        "input_features": inputs,
        "output_features": {ACTION: {"type": "ACTION", "shape": [widths[ACTION]]}},
        "device": "cpu",
        "paligemma_variant": "gemma_2b",
        "chunk_size": checkpoint.horizon,
        "n_action_steps": checkpoint.horizon,
        "image_resolution": size,
        "normalization_mapping": {
            "VISUAL": "IDENTITY",
            "STATE": theirs[preparation.modes[STATE]],
            "ACTION": theirs[preparation.modes[ACTION]],
        },
        "tokenizer_max_length": preparation.max_length,
    }
    if preparation.relative is not None:
        config["use_relative_actions"] = True
        config["action_feature_names"] = None if names is None else list(names)
    return config


VOCABULARY = 257152
_VARIANTS = {"variant": "gemma_2b", "expert_variant": "gemma_300m", "vision_variant": "so400m"}


def _preparation(checkpoint: ForeignCheckpoint) -> Preparation:
    """What LeRobot's processors must do to act as ``checkpoint``.

    Raises:
        CheckpointError: LeRobot's cannot.
    """
    numbers = table_of(checkpoint, "NormalizeStatesAndActions")
    only(numbers, "std_floor", 0.0, 0.0)
    only(numbers, "action_norm_mask", None, None)
    words = table_of(checkpoint, "ProcessPrompts")
    mode = numbers.get("norm_type", "mean_std")
    modes = {STATE: numbers.get("state_norm_type") or mode, ACTION: mode}
    entries = checkpoint.statistics["private"]
    missing = [entry for entry in KEYS.values() if entry not in entries]
    if missing:
        raise CheckpointError(
            f"the checkpoint has no statistics of {', '.join(missing)}, which LeRobot's processors "
            "need",
            cause="it is a base model that was imported",
            next="fine-tune it; a training's checkpoints have the statistics of its data",
        )
    rows = {
        key: {name: list(entries[entry][name]) for name in STATISTICS if name in entries[entry]}
        for key, entry in KEYS.items()
        if modes[key] != "none"
    }
    relative = entries["action"].get("relative")
    found = Preparation(
        modes=modes,
        statistics=rows,
        epsilon=float(numbers.get("epsilon", 1e-6)),
        epsilon_if_zero=bool(numbers.get("epsilon_if_zero", False)),
        relative=None if relative is None else [bool(counted) for counted in relative],
        tokenizer=TOKENIZER,
        max_length=int(words.get("max_len", 180)),
        renamed={},
    )
    return found if found.epsilon_if_zero else _with_lerobots_epsilon(found)


def _with_lerobots_epsilon(found: Preparation) -> Preparation:
    """The same numbers by LeRobot's formula, which adds 1e-8, and only where it must."""
    added = {"std": found.epsilon - 1e-8, "max": found.epsilon, "q99": found.epsilon}
    rows = {
        key: {name: [x + added.get(name, 0.0) for x in row] for name, row in table.items()}
        for key, table in found.statistics.items()
    }
    return replace(found, statistics=rows, epsilon=1e-8, epsilon_if_zero=True)
