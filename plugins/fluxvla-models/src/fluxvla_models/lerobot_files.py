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
from fluxvla_core.models import Stored, safetensors_in
from fluxvla_core.results import read_json

CONFIG = "config.json"
PREPROCESSOR, POSTPROCESSOR = "policy_preprocessor", "policy_postprocessor"
STATE, ACTION = "observation.state", "action"
BUFFERS = ("normalize_inputs.", "normalize_targets.", "unnormalize_outputs.")
"""How statistics are called that are among the weights, as before LeRobot 0.4."""
_SUFFIX = ".safetensors"


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
        CheckpointError: the file is missing or damaged, or has a step that is not known.
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


def whole(stored: Stored | Tensor) -> Tensor:
    """The tensor that ``stored`` stands for."""
    if isinstance(stored, Tensor):
        return stored
    return stored[tuple(slice(0, length) for length in stored.shape)]


def _state(folder: Path, name: Any, where: str) -> Mapping[str, Stored]:
    if name is None:
        return {}
    if not isinstance(name, str) or PurePath(name).name != name or not name.endswith(_SUFFIX):
        raise CheckpointError(f"state_file {name!r} is not a file next to it", where=where)
    if not os.path.lexists(folder / name):
        raise CheckpointError(f"state_file {name} is missing", where=where)
    return safetensors_in(folder, name.removesuffix(_SUFFIX))
