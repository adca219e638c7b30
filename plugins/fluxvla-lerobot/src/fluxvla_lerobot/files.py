"""Files of a LeRobot policy, read and checked before LeRobot loads them.

``config.json`` has the policy's ``type`` and its inputs and outputs; ``policy_preprocessor.json``
and ``policy_postprocessor.json`` list the steps around it (lerobot/configs/policies.py,
lerobot/processor/pipeline.py). LeRobot imports and calls whatever class a step names, and asks the
Hugging Face hub for code where a file says so: here neither comes of what a checkpoint says.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

from fluxvla_core.errors import CheckpointError
from fluxvla_core.results import read_json

CONFIG, WEIGHTS = "config.json", "model.safetensors"
PREPROCESSOR, POSTPROCESSOR = "policy_preprocessor.json", "policy_postprocessor.json"
STATE, ACTION = "observation.state", "action"
EMPTY = "observation.images.empty_camera_"
"""Inputs that a policy adds for cameras that are never there, and masks."""
RENAME = "rename_observations_processor"
REMOTE_CODE_TYPES = frozenset({"gaussian_actor", "groot", "pi0_fast", "sac", "wall_x"})
"""Types whose code in LeRobot runs Python that comes with a tokenizer or backbone."""
REMOTE_CODE_STEPS = frozenset({"action_tokenizer_processor"})


@dataclass(frozen=True)
class Described:
    """A policy of LeRobot by its files.

    Args:
        kind: LeRobot's ``type``: ``act``, ``smolvla``, ….
        cameras: feature -> name of the camera, as its training data called it.
        sizes: feature -> height and width that the files state.
        state_dim: width of the state; None for a policy that takes none.
        action_dim: width of an action.
        before, after: names of the steps of its processors.
    """

    kind: str
    cameras: Mapping[str, str]
    sizes: Mapping[str, tuple[int, int]]
    state_dim: int | None
    action_dim: int
    before: tuple[str, ...]
    after: tuple[str, ...]


def describe(folder: Path, trust_remote_code: bool = False) -> Described:
    """Read and check the files of a policy.

    Args:
        trust_remote_code: admit policies whose LeRobot code runs Python of the Hugging Face hub.

    Raises:
        CheckpointError: a file is missing or damaged; the policy takes something that no robot has
            here; or loading it would run code that the checkpoint names.
    """
    where = str(folder / CONFIG)
    config = read_json(folder / CONFIG, dict[str, Any], CheckpointError)
    kind = config.get("type")
    if not isinstance(kind, str):
        raise CheckpointError(
            f"type is {kind!r}, not the name of a policy of LeRobot",
            where=where,
            cause="the folder is not one that LeRobot saved a policy in",
        )
    if config.get("use_peft") or os.path.lexists(folder / "adapter_config.json"):
        raise CheckpointError(
            "the folder holds an adapter, which would load the weights of another folder",
            where=where,
            next="merge the adapter into its policy, and name the folder of the result",
        )
    if not (folder / WEIGHTS).is_file():
        raise CheckpointError(f"there is no {WEIGHTS}", where=str(folder))
    inputs, outputs = (
        _features(config, key, where) for key in ("input_features", "output_features")
    )
    before, after = (_steps(folder, name) for name in (PREPROCESSOR, POSTPROCESSOR))
    _refuse_remote_code(kind, {*before, *after}, trust_remote_code, where)
    seen = _renamed(before, folder)
    inputs = {name: entry for name, entry in inputs.items() if not name.startswith(EMPTY)}
    images = {name: shape for name, (sort, shape) in inputs.items() if sort == "VISUAL"}
    other = [name for name in inputs if name not in images and name != STATE]
    if other:
        raise CheckpointError(
            f"the policy takes {', '.join(other)}, which no observation has here",
            where=where,
            cause="an observation has images, joint states (observation.state) and an instruction",
        )
    if ACTION not in outputs:
        raise CheckpointError(
            f"output_features has no {ACTION!r}; it has {', '.join(outputs) or 'nothing'}",
            where=where,
        )
    for name, shape in images.items():
        if len(shape) != 3:
            raise CheckpointError(f"{name} is {shape}, not channels, height, width", where=where)
    return Described(
        kind=kind,
        cameras={name: camera_of(seen.get(name, name)) for name in images},
        sizes={name: (shape[1], shape[2]) for name, shape in images.items()},
        state_dim=_width(inputs[STATE][1], STATE, where) if STATE in inputs else None,
        action_dim=_width(outputs[ACTION][1], ACTION, where),
        before=tuple(before),
        after=tuple(after),
    )


def camera_of(feature: str) -> str:
    """The camera's name in a feature: ``observation.images.top`` -> ``top``."""
    for prefix in ("observation.images.", "observation."):
        if feature.startswith(prefix):
            return feature.removeprefix(prefix)
    return feature


def _features(
    config: Mapping[str, Any], section: str, where: str
) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Feature -> its type (``VISUAL``, ``STATE``, …) and shape."""
    listed = config.get(section)
    if not isinstance(listed, dict):
        raise CheckpointError(f"{section} is no table of features", where=where)
    found: dict[str, tuple[str, tuple[int, ...]]] = {}
    for name, entry in listed.items():
        shape = entry.get("shape") if isinstance(entry, dict) else None
        sizes = shape if isinstance(shape, list) else []
        if not sizes or not all(type(n) is int and n > 0 for n in sizes):
            raise CheckpointError(f"{section}.{name} is {entry!r}, not a shape", where=where)
        found[name] = (str(entry.get("type")), tuple(sizes))
    return found


def _width(shape: tuple[int, ...], feature: str, where: str) -> int:
    if len(shape) != 1:
        raise CheckpointError(f"{feature} is {shape}, a vector is expected", where=where)
    return shape[0]


def _steps(folder: Path, name: str) -> dict[str, Mapping[str, Any]]:
    """The steps of one of the processors: registered name -> settings."""
    file = folder / name
    if not os.path.lexists(file):
        raise CheckpointError(
            f"there is no {name}: how observations and actions are normalised is unknown",
            where=str(folder),
            cause="it was saved by LeRobot before 0.4, which kept that among the weights",
            next="python -m lerobot.processor.migrate_policy_normalization --pretrained-path "
            "FOLDER, in LeRobot's environment",
        )
    listed = read_json(file, dict[str, Any], CheckpointError).get("steps")
    if not isinstance(listed, list) or not all(isinstance(step, dict) for step in listed):
        raise CheckpointError("steps: no list of steps", where=str(file))
    found: dict[str, Mapping[str, Any]] = {}
    for step in listed:
        registered, settings = step.get("registry_name"), step.get("config") or {}
        if not isinstance(registered, str):
            raise CheckpointError(
                f"the step {step.get('class')!r} is named by its class, which would be imported "
                "and called",
                where=str(file),
                cause="what comes with weights is data, and runs nothing",
                next="register the step in a package lerobot_policy_NAME, and save the policy "
                "again",
            )
        if not isinstance(settings, dict):
            raise CheckpointError(f"{registered}: config is no table", where=str(file))
        state = step.get("state_file")
        if state is not None and (not isinstance(state, str) or PurePath(state).name != state):
            raise CheckpointError(f"state_file {state!r} is not a file next to it", where=str(file))
        found[registered] = settings
    return found


def _refuse_remote_code(kind: str, steps: set[str], trusted: bool, where: str) -> None:
    found = [f"policies of type {kind!r}"] if kind in REMOTE_CODE_TYPES else []
    found += [f"the step {name!r}" for name in sorted(steps & REMOTE_CODE_STEPS)]
    if found and not trusted:
        raise CheckpointError(
            f"{' and '.join(found)}: LeRobot runs Python code for it that comes with files of the "
            "Hugging Face hub",
            where=where,
            next="trust_remote_code = True, if you trust whoever made the checkpoint",
        )


def _renamed(before: Mapping[str, Mapping[str, Any]], folder: Path) -> dict[str, str]:
    """The policy's feature -> what a preprocessor takes it from."""
    table = before.get(RENAME, {}).get("rename_map") or {}
    names = [*table, *table.values()] if isinstance(table, dict) else [None]
    if not all(isinstance(name, str) for name in names):
        raise CheckpointError(f"{RENAME}: no table of names", where=str(folder / PREPROCESSOR))
    return {policys: robots for robots, policys in table.items()}
