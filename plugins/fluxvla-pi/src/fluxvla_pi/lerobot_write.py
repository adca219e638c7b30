"""Writes PI0 and PI0.5 as LeRobot saves them, and what PI0-FAST's files share with them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from fluxvla_models.lerobot_files import ACTION, CONFIG, STATE
from safetensors.torch import save_file

from fluxvla_core.errors import CheckpointError
from fluxvla_core.models import ForeignCheckpoint
from fluxvla_pi.lerobot_processors import (
    KEYS,
    MODES,
    STATISTICS,
    TOKENIZER,
    Preparation,
    write_processors,
)
from fluxvla_pi.names import LEROBOT
from fluxvla_pi.published import action_names, family_of, only, table_of, weights_to_write

IMAGES = "observation.images."
"""What LeRobot's names of cameras begin with."""
VOCABULARY = 257152
_VARIANTS = {"variant": "gemma_2b", "expert_variant": "gemma_300m", "vision_variant": "so400m"}


def write_pi(checkpoint: ForeignCheckpoint, folder: Path) -> None:
    """Write ``checkpoint``, of PI0 or PI0.5, into the empty ``folder``.

    Raises:
        CheckpointError: LeRobot's policies cannot compute what it computes.
    """
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
