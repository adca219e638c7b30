"""Processors that LeRobot saves beside a policy's weights, for every family.

LeRobot 0.4 and later writes ``policy_preprocessor.json`` and ``policy_postprocessor.json``: lists
of steps, each with its settings; a step's tensors are in a safetensors file next to it that its
``state_file`` names (lerobot/processor/pipeline.py).
"""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

from safetensors.torch import save_file
from torch import Tensor

from fluxvla_core.errors import CheckpointError
from fluxvla_core.models import Stored, check_settings, safetensors_in
from fluxvla_core.results import read_json

CONFIG = "config.json"
PREPROCESSOR, POSTPROCESSOR = "policy_preprocessor", "policy_postprocessor"
STATE, ACTION = "observation.state", "action"
BUFFERS = ("normalize_inputs.", "normalize_targets.", "unnormalize_outputs.")
"""How statistics are called that are among the weights, as before LeRobot 0.4."""
EPS = 1e-8
"""What LeRobot adds to a standard deviation, and puts in place of a range of 0."""
_SUFFIX = ".safetensors"


_OF_EVERY_POLICY = {
    "type",
    "n_obs_steps",
    "input_features",
    "output_features",
    "normalization_mapping",
    "device",
    "use_amp",
    "use_peft",
    "push_to_hub",
    "repo_id",
    "private",
    "tags",
    "license",
    "pretrained_path",
    "pretrained_revision",
    "chunk_size",
    "n_action_steps",
    "gradient_checkpointing",
    "compile_model",
    "compile_mode",
}
"""Settings that LeRobot's policies share; those that say how they are trained have a prefix."""
_TRAINING = ("optimizer_", "scheduler_", "freeze_", "train_", "time_sampling_")


def check_policy_settings(config: Mapping[str, Any], known: Collection[str], where: str) -> None:
    """Refuse settings of a policy's ``config.json`` that are not known; see ``check_settings``.

    Args:
        known: those of this kind of policy, besides the ones of every policy and of training.
    """
    settings = {name: v for name, v in config.items() if not name.startswith(_TRAINING)}
    check_settings(settings, {*_OF_EVERY_POLICY, *known}, where)


def check_both(statistics: Mapping[str, Any], where: str | None = None) -> None:
    """Refuse statistics of the state without those of the action, or the reverse.

    A base model has neither and is trained on; one that has half of them was copied in part.

    Args:
        statistics: feature -> its statistics; empty where it has none.

    Raises:
        CheckpointError: names the feature without statistics, and what there is.
    """
    have = [feature for feature, rows in statistics.items() if rows]
    lacks = [feature for feature, rows in statistics.items() if not rows]
    if have and lacks:
        raise CheckpointError(
            f"there are statistics of {', '.join(have)}, and none of {', '.join(lacks)}",
            where=where,
            cause="they were copied in part, or are of another dataset",
            next="copy the folder again with all of its files",
        )


@dataclass(frozen=True)
class Step:
    """One step of a processor.

    Args:
        name: that LeRobot registers it under.
        config: its settings.
        tensors: its state, each tensor read when it is used; empty if it has none.
    """

    name: str
    config: Mapping[str, Any]
    tensors: Mapping[str, Stored]


def policy_type(folder: Path) -> str | None:
    """Which of LeRobot's policies ``folder`` holds (``act``, ``pi05``), by its ``config.json``.

    None if it is not a folder of LeRobot's, or its config cannot be read.
    """
    try:
        config = read_json(folder / CONFIG, dict[str, Any], CheckpointError)
    except CheckpointError:
        return None
    kind = config.get("type")
    return kind if isinstance(kind, str) and "input_features" in config else None


def read_steps(folder: Path, stem: str, known: Collection[str] | None = None) -> list[Step]:
    """The steps of ``<stem>.json`` in ``folder``.

    Args:
        known: names of the steps that whoever reads them takes into account. One that is not among
            them changes observations or actions in a way that would be lost. None admits all.

    Raises:
        CheckpointError: the file is missing or damaged, or has a step that is not known, or a
            normalizer with settings that are not.
    """
    file = folder / f"{stem}.json"
    where = str(file)
    listed = read_json(file, dict[str, Any], CheckpointError).get("steps")
    if not isinstance(listed, list) or not all(isinstance(step, dict) for step in listed):
        raise CheckpointError("steps: no list of steps", where=where)
    steps = []
    for step in listed:
        name, config = step.get("registry_name"), step.get("config") or {}
        if not isinstance(name, str) or (known is not None and name not in known):
            raise CheckpointError(
                f"the step {name or step.get('class')!r} of the processors is not known here",
                where=where,
                cause="it was added to LeRobot's own steps, or by another version",
            )
        if not isinstance(config, dict):
            raise CheckpointError(f"{name}: config is no table", where=where)
        if name.endswith("normalizer_processor"):
            _check_normalizer(config, where)
        steps.append(Step(name, config, _state(folder, step.get("state_file"), where)))
    return steps


def write_steps(
    folder: Path,
    stem: str,
    steps: Iterable[tuple[str, Mapping[str, Any], Mapping[str, Tensor]]],
) -> None:
    """Write a processor into ``folder``: of each step its name, its settings and its state."""
    listed = []
    for number, (name, config, tensors) in enumerate(steps):
        step: dict[str, Any] = {"registry_name": name, "config": dict(config)}
        if tensors:
            step["state_file"] = f"{stem}_step_{number}_{name}{_SUFFIX}"
            save_file(dict(tensors), folder / step["state_file"])
        listed.append(step)
    text = json.dumps({"name": stem, "steps": listed}, indent=2)
    (folder / f"{stem}.json").write_text(text + "\n", encoding="utf-8")


def full_tensor(stored: Stored | Tensor) -> Tensor:
    """The tensor that ``stored`` stands for."""
    if isinstance(stored, Tensor):
        return stored
    return stored[tuple(slice(0, length) for length in stored.shape)]


def _check_normalizer(config: Mapping[str, Any], where: str) -> None:
    """Refuse what LeRobot's own policies never set, and what would give other numbers."""
    for name, known in (("eps", EPS), ("normalize_observation_keys", None)):
        value = config.get(name, known)
        if value != known:
            raise CheckpointError(
                f"{name} is {value!r}; a normalizer with {known!r} is read", where=where
            )


def _state(folder: Path, name: Any, where: str) -> Mapping[str, Stored]:
    if name is None:
        return {}
    if not isinstance(name, str) or PurePath(name).name != name or not name.endswith(_SUFFIX):
        raise CheckpointError(f"state_file {name!r} is not a file next to it", where=where)
    if not os.path.lexists(folder / name):
        raise CheckpointError(f"state_file {name} is missing", where=where)
    return safetensors_in(folder, name.removesuffix(_SUFFIX))
