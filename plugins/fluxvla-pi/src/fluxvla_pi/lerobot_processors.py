"""LeRobot's processors of the PI models: what they do to observations and actions, and their files.

``policy_preprocessor.json`` lists steps; the statistics lie next to it, in the file that the
normalizer's step names, flat as ``<feature>.<statistic>`` (LeRobot 0.4 and later). Before, they
were buffers among the weights, ``normalize_inputs.buffer_<feature with _>.<statistic>``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from fluxvla_models.lerobot_files import (
    ACTION,
    POSTPROCESSOR,
    PREPROCESSOR,
    STATE,
    Step,
    check_both,
    full_tensor,
    read_steps,
    write_steps,
)

from fluxvla_core.errors import CheckpointError
from fluxvla_core.models import Stored, safetensors_in

KEYS = {STATE: "proprio", ACTION: "action"}
"""Their features -> entries of our statistics."""
MODES = {
    "IDENTITY": "none",
    "MEAN_STD": "mean_std",
    "MIN_MAX": "min_max",
    "QUANTILES": "quantile",
}
NEEDS = {
    "none": (),
    "mean_std": ("mean", "std"),
    "min_max": ("min", "max"),
    "quantile": ("q01", "q99"),
}
STATISTICS = ("mean", "std", "min", "max", "q01", "q10", "q50", "q90", "q99")
TOKENIZER = "google/paligemma-3b-pt-224"
_KNOWN = {
    "rename_observations_processor",
    "to_batch_processor",
    "pi0_new_line_processor",
    "pi05_prepare_state_tokenizer_processor_step",
    "pi0_fast_prepare_state_tokenizer_processor_step",
    "action_tokenizer_processor",
    "tokenizer_processor",
    "device_processor",
    "relative_actions_processor",
    "normalizer_processor",
}
_KNOWN_AFTER = {"unnormalizer_processor", "absolute_actions_processor", "device_processor"}
_NORMALIZER, _UNNORMALIZER = "normalizer_processor", "unnormalizer_processor"
_ABSOLUTE = "absolute_actions_processor"


@dataclass(frozen=True)
class Preparation:
    """What happens to states, actions and words.

    Args:
        modes: feature -> ``norm_type``.
        statistics: feature -> statistic -> numbers.
        epsilon: added to what is divided by.
        epsilon_if_zero: only where a range is 0.
        relative: which actions are counted from the state; None if none is.
        tokenizer: its name.
        max_length: tokens of a prompt.
        renamed: the robot's name of an observation -> the policy's.
    """

    modes: Mapping[str, str]
    statistics: Mapping[str, Mapping[str, Sequence[float]]]
    epsilon: float
    epsilon_if_zero: bool
    relative: Sequence[bool] | None
    tokenizer: str
    max_length: int
    renamed: Mapping[str, str]


def from_files(folder: Path, widths: Mapping[str, int]) -> Preparation:
    """The preparation that ``policy_preprocessor.json`` in ``folder`` describes.

    Args:
        widths: of states and actions.

    Raises:
        CheckpointError: steps or settings that are not known here, or statistics that are missing.
    """
    where = str(folder / f"{PREPROCESSOR}.json")
    steps = {step.name: step for step in read_steps(folder, PREPROCESSOR, _KNOWN)}
    after: dict[str, Step] = {}
    if (folder / f"{POSTPROCESSOR}.json").is_file():
        after = {step.name: step for step in read_steps(folder, POSTPROCESSOR, _KNOWN_AFTER)}
    missing = sorted({_NORMALIZER, "tokenizer_processor"} - set(steps))
    if missing:
        raise CheckpointError(f"there is no step {', '.join(missing)}", where=where)
    normalizer, words = steps[_NORMALIZER].config, steps["tokenizer_processor"].config
    modes = _modes(normalizer.get("norm_map", {}), where)
    found: dict[str, dict[str, Sequence[float]]] = {}
    tensors = steps[_NORMALIZER].tensors
    if tensors:
        found = {key: _rows(tensors, f"{key}.", widths[key], where) for key in KEYS}
    if _UNNORMALIZER in after:  # what makes physical actions has the last word on them
        last = after[_UNNORMALIZER]
        modes[ACTION] = _modes(last.config.get("norm_map", {}), where)[ACTION]
        if last.tensors:
            found[ACTION] = _rows(last.tensors, f"{ACTION}.", widths[ACTION], where)
    _check(found, modes, where)
    settings = {name: step.config for name, step in steps.items()}
    relative = settings.get("relative_actions_processor", {})
    absolute = after[_ABSOLUTE].config.get("enabled", False) if _ABSOLUTE in after else None
    if absolute not in (None, relative.get("enabled", False)):
        raise CheckpointError(
            f"enabled of {_ABSOLUTE} is {absolute!r}, of relative_actions_processor "
            f"{relative.get('enabled', False)!r}",
            where=where,
        )
    for key in ("exclude_joints", "action_names"):
        _setting(relative, key, [], (list, type(None)), where)
    names = settings.get("rename_observations_processor", {})
    return Preparation(
        modes=modes,
        statistics=found,
        epsilon=_setting(normalizer, "eps", 1e-8, (int, float), where),
        epsilon_if_zero=True,
        relative=_relative(relative, widths[ACTION]) if relative.get("enabled") else None,
        tokenizer=_setting(words, "tokenizer_name", TOKENIZER, str, where),
        max_length=_setting(words, "max_length", 512, int, where),
        renamed=_setting(names, "rename_map", {}, dict, where),
    )


def from_buffers(
    folder: Path, config: Mapping[str, Any], widths: Mapping[str, int], max_length: int
) -> Preparation:
    """The preparation of LeRobot before 0.4, whose statistics are among the weights.

    Raises:
        CheckpointError: modes that are not known here, or statistics that are missing.
    """
    where = str(folder)
    modes = _modes(config.get("normalization_mapping", {}), where)
    tensors = safetensors_in(folder)
    prefixes = {
        STATE: "normalize_inputs.buffer_observation_state.",
        ACTION: "unnormalize_outputs.buffer_action.",
    }
    found = {key: _rows(tensors, prefixes[key], widths[key], where, True) for key in KEYS}
    _check(found, modes, where)
    return Preparation(
        modes=modes,
        statistics=found,
        epsilon=1e-8,
        epsilon_if_zero=False,
        relative=None,
        tokenizer=TOKENIZER,
        max_length=max_length,
        renamed={},
    )


def write_processors(
    folder: Path,
    family: str,
    features: Mapping[str, Mapping[str, Any]],
    preparation: Preparation,
    names: Sequence[str] | None,
    action_tokens: Mapping[str, Any] | None = None,
) -> None:
    """Write both processors of ``family`` into ``folder``.

    Args:
        features: all of them as LeRobot's config has them, those of actions last.
        preparation: with ``epsilon_if_zero`` and LeRobot's epsilon.
        names: of the actions, where some are relative.
        action_tokens: settings of the step that writes actions as tokens, of PI0-FAST.
    """
    theirs = {ours: mode for mode, ours in MODES.items()}
    normalizer = {
        "eps": preparation.epsilon,
        "features": features,
        "norm_map": {
            "VISUAL": "IDENTITY",
            "STATE": theirs[preparation.modes[STATE]],
            "ACTION": theirs[preparation.modes[ACTION]],
        },
    }
    relative = preparation.relative is not None
    apart = [] if preparation.relative is None else _apart(preparation.relative, names or ())
    words: list[tuple[str, dict[str, Any]]] = [
        (
            "tokenizer_processor",
            {
                "max_length": preparation.max_length,
                "task_key": "task",
                "padding_side": "right",
                "padding": "max_length",
                "truncation": True,
                "tokenizer_name": TOKENIZER,
            },
        )
    ]
    if action_tokens is not None:
        words.append(("action_tokenizer_processor", dict(action_tokens)))
    words.append(("device_processor", {"device": "cpu", "float_dtype": None}))
    numbers: list[tuple[str, dict[str, Any]]] = [
        (
            "relative_actions_processor",
            {
                "enabled": relative,
                "exclude_joints": apart if relative else ["gripper"],
                "action_names": list(names) if relative and names else None,
            },
        ),
        (_NORMALIZER, normalizer),
    ]
    first: list[tuple[str, dict[str, Any]]] = [
        ("rename_observations_processor", {"rename_map": {}}),
        ("to_batch_processor", {}),
    ]
    if family == "pi0":
        steps = [*first, ("pi0_new_line_processor", {}), *words, *numbers]
    else:
        steps = [*first, *numbers, (f"{family}_prepare_state_tokenizer_processor_step", {}), *words]
    action = {ACTION: features[ACTION]}
    after: list[tuple[str, dict[str, Any]]] = [
        ("unnormalizer_processor", {**normalizer, "features": action}),
        ("absolute_actions_processor", {"enabled": relative}),
        ("device_processor", {"device": "cpu", "float_dtype": None}),
    ]
    tensors = {
        f"{key}.{name}": torch.tensor(row, dtype=torch.float32)
        for key, rows in preparation.statistics.items()
        for name, row in rows.items()
    }
    for stem, listed in ((PREPROCESSOR, steps), (POSTPROCESSOR, after)):
        states = (tensors if step.endswith("normalizer_processor") else {} for step, _ in listed)
        write_steps(
            folder, stem, [(*step, state) for step, state in zip(listed, states, strict=True)]
        )


def _setting(
    config: Mapping[str, Any], key: str, default: Any, kind: type | tuple[type, ...], where: str
) -> Any:
    """A step's setting, of the type that LeRobot gives it."""
    value = config.get(key, default)
    if not isinstance(value, kind):
        raise CheckpointError(f"{key} is {value!r}", where=where)
    return value


def _modes(given: Any, where: str) -> dict[str, str]:
    """Feature -> ``norm_type``, of a table by kinds of features."""
    if not isinstance(given, Mapping):
        raise CheckpointError(f"no table of normalizations: {given!r}", where=where)
    unknown = {key: mode for key, mode in given.items() if mode not in MODES}
    if unknown:
        raise CheckpointError(
            f"normalizations {unknown} are not known here; {', '.join(MODES)} are", where=where
        )
    if given.get("VISUAL", "IDENTITY") != "IDENTITY":
        raise CheckpointError(
            f"images are normalized by {given['VISUAL']}; PI0 and PI0.5 take them as they are",
            where=where,
        )
    return {
        STATE: MODES[given.get("STATE", "IDENTITY")],
        ACTION: MODES[given.get("ACTION", "IDENTITY")],
    }


def _rows(
    tensors: Mapping[str, Stored], prefix: str, width: int, where: str, unfilled: bool = False
) -> dict[str, Sequence[float]]:
    """The statistics whose names begin with ``prefix``.

    Args:
        unfilled: those that are infinite throughout were never filled, as before LeRobot 0.4.
    """
    found: dict[str, Sequence[float]] = {}
    for name in STATISTICS:
        stored = tensors.get(prefix + name)
        if stored is None:
            continue
        row = full_tensor(stored).float()
        if row.shape != (width,):
            raise CheckpointError(
                f"{prefix}{name} has shape {tuple(row.shape)}, {width} numbers are expected",
                where=where,
            )
        if torch.isfinite(row).all():
            found[name] = row.tolist()
        elif not (unfilled and torch.isinf(row).all()):
            raise CheckpointError(
                f"{prefix}{name} is {row.tolist()}; finite numbers are expected", where=where
            )
    return found


def _check(found: Mapping[str, Mapping[str, Any]], modes: Mapping[str, str], where: str) -> None:
    """Statistics are there as a whole for a feature, or not at all, as in base models."""
    check_both({key: found.get(key) for key in KEYS if modes[key] != "none"}, where)
    for key, rows in found.items():
        lacks = [name for name in NEEDS[modes[key]] if name not in rows]
        if rows and lacks:
            raise CheckpointError(
                f"{key} is normalized by {modes[key]}, and has no {', '.join(lacks)} but "
                f"{', '.join(rows)}",
                where=where,
            )


def _relative(config: Mapping[str, Any], width: int) -> list[bool]:
    """Which actions are relative: all but those whose names hold an excluded joint's."""
    apart = [str(name).lower() for name in config.get("exclude_joints") or () if name]
    names = [str(name).lower() for name in config.get("action_names") or ()][:width]
    found = [not any(token in name for token in apart) for name in names]
    return found + [True] * (width - len(found))


def _apart(relative: Sequence[bool], names: Sequence[str]) -> list[str]:
    """Names of the joints that are not relative.

    Raises:
        CheckpointError: no names by which LeRobot could distinguish them.
    """
    if all(relative):
        return []
    apart = [name for name, counted in zip(names, relative, strict=False) if not counted]
    config = {"exclude_joints": apart, "action_names": list(names)}
    if not apart or _relative(config, len(relative)) != list(relative):
        raise CheckpointError(
            "some actions are relative to the state and some are not; LeRobot distinguishes "
            f"them by name, which {', '.join(names) or 'no names'} do not allow"
        )
    return apart
