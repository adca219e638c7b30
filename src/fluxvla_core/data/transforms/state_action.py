"""Transforms of states and actions: normalise and denormalise."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.frame import Sample
from fluxvla_core.contracts.training import Transform
from fluxvla_core.data.statistics import (
    EPS,
    Affine,
    check_norm_type,
    find_idle_dimensions,
    make_affine,
)
from fluxvla_core.errors import ConfigError
from fluxvla_core.untrusted import read_json

Floats = npt.NDArray[np.float64]


class NormalizeStatesAndActions(Transform):
    """Normalise ``states`` ``(D,)`` and, where there are any, ``actions`` ``(T, D)``.

    The statistics are ``sample["stats"][state_key]`` and ``[action_key]``. The result is float32,
    padded with ``pad_value`` to ``state_dim`` and ``action_dim``. Nothing is clipped.

    Args:
        state_key, action_key: entries of the statistics, usually ``proprio`` and ``action``.
        action_dim, state_dim: widths that the model wants; the data's own if None.
        norm_type: ``mean_std``, ``quantile``, ``min_max`` or ``none``.
        state_norm_type: that of states, where it is another one.
        action_norm_mask: ``(D,)``, D being the data's own width; False neither shifts nor scales
            a dimension (relative ones are counted from the state all the same).
        std_floor: no dimension is divided by less than this, in the data's units.
        epsilon: added to the divisor: 1e-6 in openpi, 1e-8 in LeRobot.
        epsilon_if_zero: ranges (``quantile``, ``min_max``) get it only where they are 0, as
            LeRobot has it.

    Raises:
        ConfigError: an unknown ``norm_type``, an ``epsilon`` below 0, statistics that are missing
            or of another width, or a width that would cut dimensions off.
    """

    keeps_images = True

    def __init__(
        self,
        state_key: str = "proprio",
        action_key: str = "action",
        action_dim: int | None = None,
        state_dim: int | None = None,
        norm_type: str = "mean_std",
        pad_value: float = 0.0,
        action_norm_mask: Sequence[bool] | None = None,
        std_floor: float = 0.0,
        state_norm_type: str | None = None,
        epsilon: float = EPS,
        epsilon_if_zero: bool = False,
    ) -> None:
        _check_settings(norm_type, epsilon, type(self).__name__)
        _check_settings(state_norm_type or norm_type, epsilon, type(self).__name__)
        self.state_norm_type = state_norm_type or norm_type
        self.epsilon = epsilon
        self.epsilon_if_zero = epsilon_if_zero
        self.state_key = state_key
        self.action_key = action_key
        self.action_dim = action_dim
        self.state_dim = state_dim
        self.norm_type = norm_type
        self.pad_value = pad_value
        self.action_norm_mask = action_norm_mask
        self.std_floor = std_floor
        self._known: tuple[Any, Affine, Affine] | None = None

    def __call__(self, sample: Sample) -> Sample:
        state_scale, action_scale = self._scales(sample.get("stats"))
        states = sample["states"]
        _check_width("states", states, state_scale.dim, self.state_key)
        out = {**sample, "states": self._pad(state_scale.forward(states), self.state_dim, "state")}
        if "actions" in sample:
            actions = sample["actions"]
            _check_width("actions", actions, action_scale.dim, self.action_key)
            _check_steps(actions, action_scale, self.action_key)
            scaled = action_scale.forward(actions, states)
            out["actions"] = self._pad(scaled, self.action_dim, "action")
        return out

    def denormalizer(
        self, norm_stats: Mapping[str, Any], statistic_name: str = "private"
    ) -> DenormalizePrivateAction:
        """The transform that undoes this one's actions."""
        return DenormalizePrivateAction(
            norm_stats=norm_stats,
            norm_type=self.norm_type,
            action_norm_mask=self.action_norm_mask,
            std_floor=self.std_floor,
            epsilon=self.epsilon,
            epsilon_if_zero=self.epsilon_if_zero,
            statistic_name=statistic_name,
            action_key=self.action_key,
        )

    def warnings(
        self, stats: Mapping[str, Any], states: Sequence[str] = (), actions: Sequence[str] = ()
    ) -> list[str]:
        """Warnings before training by ``stats``: dimensions that hardly move in the data.

        ``states`` and ``actions`` are the names of the dimensions.

        Raises:
            ConfigError: one that does move, but rarely, would be divided by its ``quantile``
                range of 0: its moves would be blown up a million times.
        """
        if self.norm_type == "none":
            return []
        state, action = self._scales(stats)
        entries = stats[self.state_key], stats[self.action_key]
        mask = self.action_norm_mask
        moved = list(find_idle_dimensions("action", entries[1], action.scale, actions, mask))
        found = [
            *find_idle_dimensions("state", entries[0], state.scale, states),
            # One that never moves does no harm here: it stays there, whatever a model predicts.
            *(dimension for dimension in moved if dimension.blown_up),
        ]
        who = f"{type(self).__name__}(norm_type={self.norm_type!r}, std_floor={self.std_floor:g})"
        todo = (
            f"--set <{type(self).__name__}>.std_floor=0.01 or so, in the data's units: "
            "nothing is divided by less; "
            "or another norm_type"
        )
        rare = [dimension for dimension in found if dimension.blown_up and dimension.rare]
        if self.norm_type == "quantile" and rare:
            raise ConfigError(
                f"{who} would blow up {', '.join(map(str, rare))}",
                cause="they move in under 2 % of the frames, so that q01 and q99 are equal",
                next=todo,
            )
        if not found:
            return []
        return [
            f"{who} divides by next to nothing what hardly moves in the data, so that small errors "
            f"and rare moves become huge numbers: {', '.join(map(str, found))}; {todo}"
        ]

    def _scales(self, stats: Any) -> tuple[Affine, Affine]:
        if self._known is None or self._known[0] is not stats:
            who = type(self).__name__
            state, action = (_entry(stats, key, who) for key in (self.state_key, self.action_key))
            shared: dict[str, Any] = {
                "epsilon": self.epsilon,
                "epsilon_if_zero": self.epsilon_if_zero,
            }
            self._known = (
                stats,
                make_affine(state, self.state_norm_type, who, self.std_floor, **shared),
                make_affine(
                    action, self.norm_type, who, self.std_floor, self.action_norm_mask, **shared
                ),
            )
        return self._known[1:]

    def _pad(self, values: Floats, dim: int | None, what: str) -> npt.NDArray[np.float32]:
        have = values.shape[-1]
        if dim is None or dim == have:
            return values.astype(np.float32)
        if dim < have:
            raise ConfigError(
                f"{type(self).__name__}: {what}_dim {dim} would cut the data's {have} dimensions",
                next=f"as wide as the model's input, {have} or more: "
                f"--set <{type(self).__name__}>.{what}_dim={have}",
            )
        widths = [(0, 0)] * (values.ndim - 1) + [(0, dim - have)]
        return np.pad(values, widths, constant_values=self.pad_value).astype(np.float32)


class DenormalizePrivateAction(Transform):
    """Denormalise a model's actions: the exact inverse of ``NormalizeStatesAndActions``.

    Called with ``{"action": (1, T, D) or (T, D)}``, and ``"states"`` ``(D,)`` in physical units
    when the statistics count actions from the state. Returns ``(T, action_dim)`` float64.

    Args:
        norm_stats: the statistics, or the path of ``dataset_statistics.json``.
        action_dim: the robot's width; what a model's padding added is cut off.
        norm_type, action_norm_mask, std_floor, epsilon, epsilon_if_zero: as in training.
        statistic_name, action_key: where in ``norm_stats`` the action's entry is.

    Raises:
        ConfigError: an unknown ``norm_type``, no statistics, or an action of another width.
    """

    def __init__(
        self,
        norm_stats: Mapping[str, Any] | str | Path | None = None,
        action_dim: int | None = None,
        norm_type: str = "mean_std",
        action_norm_mask: Sequence[bool] | None = None,
        std_floor: float = 0.0,
        statistic_name: str = "private",
        action_key: str = "action",
        epsilon: float = EPS,
        epsilon_if_zero: bool = False,
    ) -> None:
        _check_settings(norm_type, epsilon, type(self).__name__)
        self.epsilon = epsilon
        self.epsilon_if_zero = epsilon_if_zero
        self.norm_stats = None if norm_stats is None else load_statistics(norm_stats)
        self.action_dim = action_dim
        self.norm_type = norm_type
        self.action_norm_mask = action_norm_mask
        self.std_floor = std_floor
        self.statistic_name = statistic_name
        self.action_key = action_key
        self._affine: Affine | None = None

    def __call__(self, data: Mapping[str, Any]) -> Floats:  # type: ignore[override]  # no sample
        action = np.asarray(data["action"], np.float64)
        if action.ndim == 3 and len(action) == 1:
            action = action[0]
        if action.ndim != 2:
            raise ConfigError(
                f"{type(self).__name__}: one chunk (T, D) is expected, got shape {action.shape}"
            )
        scale = self._scale()
        if action.shape[-1] < scale.dim:
            raise ConfigError(
                f"{type(self).__name__}: the model gives {action.shape[-1]} dimensions, "
                f"the statistics describe {scale.dim}"
            )
        _check_steps(action, scale, self.action_key, type(self).__name__)
        return scale.inverse(action[:, : scale.dim], data.get("states"))

    def _scale(self) -> Affine:
        if self._affine is None:
            who = type(self).__name__
            if self.norm_stats is None:
                raise ConfigError(
                    f"{who}: there are no statistics", next="give norm_stats, or load a checkpoint"
                )
            entries = _entry(self.norm_stats, self.statistic_name, who)
            stats = _entry(entries, self.action_key, who)
            affine = make_affine(
                stats,
                self.norm_type,
                who,
                self.std_floor,
                self.action_norm_mask,
                self.epsilon,
                self.epsilon_if_zero,
            )
            if self.action_dim not in (None, affine.dim):
                raise ConfigError(
                    f"{who}: action_dim is {self.action_dim}, "
                    f"the statistics describe {affine.dim} dimensions"
                )
            self._affine = affine
        return self._affine


def load_statistics(source: Mapping[str, Any] | str | Path) -> Mapping[str, Any]:
    """Load statistics: a mapping as it is, or from the path of a JSON file.

    Raises:
        ConfigError: the file is missing or not JSON.
    """
    if isinstance(source, Mapping):
        return source
    path = Path(source)
    if not os.path.lexists(path):
        raise ConfigError(
            f"norm_stats: {path} does not exist",
            next="a checkpoint carries it as dataset_statistics.json",
        )
    try:
        return read_json(path, dict[str, Any], ConfigError)
    except ConfigError as error:
        raise ConfigError(f"norm_stats: {path}: {error.what}") from error


def _check_settings(norm_type: str, epsilon: float, who: str) -> None:
    check_norm_type(norm_type, who)
    if not epsilon >= 0:
        raise ConfigError(f"{who}: epsilon must be at least 0, got {epsilon}")


def _entry(stats: Any, key: str, who: str) -> Mapping[str, Any]:
    if not isinstance(stats, Mapping) or key not in stats:
        have = (", ".join(sorted(stats)) if isinstance(stats, Mapping) else "") or "nothing"
        raise ConfigError(f"{who}: the statistics have no entry {key!r}; they have {have}")
    entry = stats[key]
    if not isinstance(entry, Mapping):
        raise ConfigError(f"{who}: the statistics' entry {key!r} is not a table")
    return entry


def _check_steps(
    actions: Any, scale: Affine, key: str, who: str = "NormalizeStatesAndActions"
) -> None:
    """Statistics of every step of a window fit windows of that length only."""
    steps = np.shape(actions)[-2] if np.ndim(actions) > 1 else 1
    if scale.offset.ndim > 1 and len(scale.offset) != steps:
        raise ConfigError(
            f"{who}: actions of {steps} steps, the statistics {key!r} "
            f"describe {len(scale.offset)} steps one by one",
            cause="per_step_statistics of a window of another length",
            next="make action_window_size that of the statistics, or compute them again",
        )


def _check_width(what: str, values: Any, dim: int, key: str) -> None:
    if np.ndim(values) == 0 or np.shape(values)[-1] != dim:
        raise ConfigError(
            f"NormalizeStatesAndActions: {what} have shape {np.shape(values)}, "
            f"the statistics {key!r} describe {dim} dimensions",
            cause="the statistics belong to another dataset or robot",
        )
