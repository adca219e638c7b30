"""Normalisation of a LeRobot policy, as this project's statistics and transforms.

LeRobot saves statistics with the processors, ``policy_preprocessor.json`` and the safetensors file
that its ``normalizer_processor`` names (``<feature>.<statistic>``); before version 0.4 they were
among the weights (``normalize_inputs.buffer_<feature>.<statistic>``, with ``_`` for each ``.``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import CheckpointError
from fluxvla_core.models import Stored, safetensors_in
from fluxvla_models.lerobot_files import (
    ACTION,
    BUFFERS,
    CONFIG,
    EPS,
    POSTPROCESSOR,
    PREPROCESSOR,
    STATE,
    check_both,
    full_tensor,
    read_steps,
)

Floats = npt.NDArray[np.float64]
_KNOWN = {
    "rename_observations_processor",
    "to_batch_processor",
    "device_processor",
    "normalizer_processor",
    "unnormalizer_processor",
}
_NORM_TYPES = {"MEAN_STD": "mean_std", "MIN_MAX": "min_max", "QUANTILES": "quantile"}
"""LeRobot's modes -> those of ``NormalizeStatesAndActions``."""
_RANGES = {"MIN_MAX": ("min", "max"), "QUANTILES": ("q01", "q99"), "QUANTILE10": ("q10", "q90")}


@dataclass(frozen=True)
class Normalization:
    """How each feature of a policy is normalised.

    Args:
        modes: ``VISUAL``, ``STATE``, ``ACTION`` -> ``MEAN_STD``, ``MIN_MAX``, ``IDENTITY``, …
        statistics: feature -> statistic -> numbers. A feature that has none stays as it is.
        renamed: the robot's name of a feature -> the policy's.
    """

    modes: Mapping[str, str]
    statistics: Mapping[str, Mapping[str, Floats]]
    renamed: Mapping[str, str] | None = None

    def affine(self, feature: str, kind: str, width: int) -> tuple[Floats, Floats]:
        """Offset and scale ``(width,)``: normalised is ``(x - offset) / scale``.

        Raises:
            CheckpointError: the mode is unknown, or a statistic of it is missing.
        """
        mode = self.modes.get(kind, "IDENTITY")
        have = self.statistics.get(feature)
        if mode == "IDENTITY" or have is None:
            return np.zeros(width), np.ones(width)
        if mode == "MEAN_STD":
            mean, std = self._numbers(feature, mode, ("mean", "std"), width)
            return mean, std + EPS
        if mode not in _RANGES:
            raise CheckpointError(f"{feature} is normalised by {mode}, which is not known here")
        low, high = self._numbers(feature, mode, _RANGES[mode], width)
        wide = np.where(high == low, EPS, high - low)
        return low + wide / 2, wide / 2

    def entry(self, feature: str, kind: str, width: int) -> tuple[dict[str, list[float]], str]:
        """A feature's statistics, and the ``norm_type`` that makes LeRobot's numbers of them.

        Raises:
            CheckpointError: the mode is unknown, or a statistic of it is missing.
        """
        mode = self.modes.get(kind, "IDENTITY")
        offset, scale = self.affine(feature, kind, width)
        have = self.statistics.get(feature, {})
        kept = {name: have[name].reshape(-1).tolist() for name in ("min", "max") if name in have}
        if feature not in self.statistics:
            mode = "IDENTITY"
        if mode == "MEAN_STD":
            kept |= {name: have[name].reshape(-1).tolist() for name in ("mean", "std")}
        elif mode in _NORM_TYPES:
            kept |= {name: have[name].reshape(-1).tolist() for name in _RANGES[mode]}
            kept |= {"mean": offset.tolist(), "std": scale.tolist()}
        elif mode in _RANGES:  # by mean and std: no range of that name is known
            # What never moves becomes -1, as there, although 1e-8 is added to a std of 0.
            scale = np.maximum(scale, EPS)
            offset = np.asarray(have[_RANGES[mode][0]], np.float64).reshape(-1) + scale
            kept |= {"mean": offset.tolist(), "std": (scale - EPS).tolist()}
        else:
            kept |= {"mean": offset.tolist(), "std": scale.tolist()}
            return kept, "none"
        return kept, _NORM_TYPES.get(mode, "mean_std")

    def _numbers(
        self, feature: str, mode: str, names: Sequence[str], width: int
    ) -> tuple[Floats, ...]:
        have = self.statistics[feature]
        missing = [name for name in names if name not in have]
        if missing:
            raise CheckpointError(
                f"{feature} is normalised by {mode}, and the checkpoint's statistics have no "
                f"{missing[0]}; they have {', '.join(sorted(have)) or 'nothing'}"
            )
        found = tuple(np.asarray(have[name], np.float64).reshape(-1) for name in names)
        for name, numbers in zip(names, found, strict=True):
            if len(numbers) != width or not np.isfinite(numbers).all():
                raise CheckpointError(
                    f"{feature}.{name} of the checkpoint's statistics is {numbers.tolist()}; "
                    f"{width} finite numbers are expected"
                )
        return found


def read_normalization(folder: Path, config: Mapping[str, Any]) -> Normalization:
    """The policy's normalisation, from the processors' files or from among the weights.

    Raises:
        CheckpointError: there is none, or a file is damaged.
    """
    if (folder / f"{PREPROCESSOR}.json").is_file():
        return _of_processors(folder, config)
    features = [*config.get("input_features", {}), *config.get("output_features", {})]
    names = {f"buffer_{feature.replace('.', '_')}": feature for feature in features}
    statistics: dict[str, dict[str, Floats]] = {}
    for name, stored in safetensors_in(folder).items():
        _, _, rest = name.partition(".")
        feature, _, statistic = rest.rpartition(".")
        if name.startswith(BUFFERS) and feature in names:
            statistics.setdefault(names[feature], {})[statistic] = _array(stored)
    if not statistics:
        raise CheckpointError(
            f"there is neither {PREPROCESSOR}.json nor statistics among the weights",
            where=str(folder),
            cause="the folder was copied without the processors' files",
        )
    return Normalization(_modes(config), statistics)


def tables(
    normalization: Normalization,
    cameras: Sequence[str],
    size: tuple[int, int],
    joints: int,
    dim: int,
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Transforms from a robot's observation to a batch, and their statistics.

    Args:
        cameras: the images' features, in the order of the model; size: their height and width.
        joints, dim: widths of state and action.
    """
    used = {STATE: "STATE", ACTION: "ACTION"}
    normalized = [f for f, kind in used.items() if normalization.modes.get(kind) != "IDENTITY"]
    check_both({f: normalization.statistics.get(f) for f in normalized})
    scales = [normalization.affine(name, "VISUAL", 3) for name in cameras]
    proprio, state_norm = normalization.entry(STATE, "STATE", joints)
    action, action_norm = normalization.entry(ACTION, "ACTION", dim)
    transforms: list[dict[str, Any]] = [
        {"type": "ResizeImages", "height": size[0], "width": size[1]},
        {
            "type": "NormalizeImages",
            "means": [offset.tolist() for offset, _ in scales],
            # 1e-8 is added there, as here; of one camera's numbers none is 0.
            "stds": [(scale - 1e-8).tolist() for _, scale in scales],
            "scale_to_unit_interval": True,
        },
        {
            "type": "NormalizeStatesAndActions",
            "state_key": "proprio",
            "action_key": "action",
            "norm_type": action_norm,
            "state_norm_type": state_norm,
            "epsilon": EPS,
            "epsilon_if_zero": True,
        },
    ]
    return transforms, {"private": {"proprio": proprio, "action": action}}


def _of_processors(folder: Path, config: Mapping[str, Any]) -> Normalization:
    statistics: dict[str, dict[str, Floats]] = {}
    modes, names = _modes(config), {}
    # What makes physical actions of the model's comes after it: it has the last word on actions,
    # and none on what is observed.
    stems = [stem for stem in (PREPROCESSOR, POSTPROCESSOR) if (folder / f"{stem}.json").is_file()]
    for stem in stems:
        file = folder / f"{stem}.json"
        for step in read_steps(folder, stem, _KNOWN):
            if step.name == "rename_observations_processor":
                names = dict(_table(step.config, "rename_map", file))
            if not step.name.endswith("normalizer_processor"):
                continue
            after, norms = stem == POSTPROCESSOR, _table(step.config, "norm_map", file)
            modes |= {kind: mode for kind, mode in norms.items() if kind == "ACTION" or not after}
            for name, stored in step.tensors.items():
                feature, _, statistic = name.rpartition(".")
                if feature == ACTION or not after:
                    statistics.setdefault(feature, {})[statistic] = _array(stored)
    return Normalization(modes, statistics, names)


def _modes(config: Mapping[str, Any]) -> dict[str, str]:
    found = _table(config, "normalization_mapping", Path(CONFIG))
    return {str(kind): str(mode) for kind, mode in found.items()}


def _table(values: Mapping[str, Any], name: str, where: Path) -> Mapping[str, Any]:
    found = values.get(name) or {}
    if not isinstance(found, dict):
        raise CheckpointError(f"{name} is no table", where=str(where))
    return found


def _array(stored: Stored) -> Floats:
    return np.asarray(full_tensor(stored).double().numpy())
