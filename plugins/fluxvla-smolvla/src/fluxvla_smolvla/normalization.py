"""``SmolVLANormalize``: states and actions as LeRobot scales them, bit for bit.

In fp32, by the formulas of LeRobot's ``NormalizerProcessorStep``: ``(x - mean) / (std + 1e-8)``,
and back ``x * std + mean``; a range from ``low`` to ``high`` becomes -1..1, with 1e-8 in place of a
range of 0. A checkpoint that LeRobot trained acts the same only if it is given the same numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core import Transform
from fluxvla_core.errors import ConfigError, DataError

EPS = 1e-8
RANGES = {"min_max": ("min", "max"), "quantile": ("q01", "q99"), "quantile10": ("q10", "q90")}
NORM_TYPES = ("mean_std", *RANGES, "none")
Floats = npt.NDArray[np.float32]


class SmolVLANormalize(Transform):
    """Normalise ``states`` ``(S,)`` and, where there are any, ``actions`` ``(T, A)``; pad by zeros.

    Args:
        state_dim, action_dim: widths that the model wants: its ``max_state_dim`` and
            ``max_action_dim``.
        state_norm, action_norm: ``mean_std``, ``min_max``, ``quantile`` (q01 and q99),
            ``quantile10`` (q10 and q90) or ``none``.
        state_key, action_key: entries of the statistics.

    Raises:
        ConfigError: an unknown norm, statistics that are missing or of relative actions, or a
            width that would cut dimensions off.
        DataError: states or actions of another width than the statistics.
    """

    keeps_images = True

    def __init__(
        self,
        state_dim: int = 32,
        action_dim: int = 32,
        state_norm: str = "mean_std",
        action_norm: str = "mean_std",
        state_key: str = "proprio",
        action_key: str = "action",
    ) -> None:
        for name, norm in (("state_norm", state_norm), ("action_norm", action_norm)):
            if norm not in NORM_TYPES:
                raise ConfigError(
                    f"SmolVLANormalize: {name} {norm!r} is not one of {', '.join(NORM_TYPES)}"
                )
        self.state_dim, self.action_dim = state_dim, action_dim
        self.state_norm, self.action_norm = state_norm, action_norm
        self.state_key, self.action_key = state_key, action_key
        self._known: tuple[Any, Scale, Scale] | None = None

    def __call__(self, sample: dict[str, Any]) -> dict[str, Any]:
        state_scale, action_scale = self._scales(sample.get("stats"))
        states = state_scale.forward(sample["states"], "states")
        out = {**sample, "states": _pad(states, self.state_dim, "state_dim")}
        if "actions" in sample:
            actions = action_scale.forward(sample["actions"], "actions")
            out["actions"] = _pad(actions, self.action_dim, "action_dim")
        return out

    def denormalizer(
        self, norm_stats: Mapping[str, Any], statistic_name: str = "private"
    ) -> SmolVLADenormalize:
        """The transform that undoes this one's actions."""
        if statistic_name not in norm_stats:
            raise ConfigError(
                f"SmolVLANormalize: there are no statistics {statistic_name!r}; there are "
                f"{', '.join(sorted(norm_stats)) or 'none'}"
            )
        stats = norm_stats[statistic_name]
        return SmolVLADenormalize(make_scale(stats, self.action_key, self.action_norm))

    def _scales(self, stats: Any) -> tuple[Scale, Scale]:
        if self._known is None or self._known[0] is not stats:
            state = make_scale(stats, self.state_key, self.state_norm)
            action = make_scale(stats, self.action_key, self.action_norm)
            self._known = (stats, state, action)
        return self._known[1:]


class SmolVLADenormalize(Transform):
    """``{"action": (1, T, D)}`` normalised -> ``(T, A)`` float64 in physical units."""

    def __init__(self, scale: Scale) -> None:
        self.scale = scale

    def __call__(self, data: Mapping[str, Any]) -> npt.NDArray[np.float64]:  # type: ignore[override]
        action = np.asarray(data["action"], np.float32)
        if action.ndim == 3 and len(action) == 1:
            action = action[0]
        if action.ndim != 2 or action.shape[1] < self.scale.dim:
            raise ConfigError(
                f"SmolVLANormalize: the model gives actions of shape {action.shape}, the "
                f"statistics describe {self.scale.dim} dimensions"
            )
        if self.scale.low.ndim > 1 and len(self.scale.low) != len(action):
            raise ConfigError(
                f"SmolVLANormalize: the model gives {len(action)} actions, the statistics describe "
                f"{len(self.scale.low)} steps one by one",
                cause="per_step_statistics of a chunk of another length",
            )
        return self.scale.inverse(action[:, : self.scale.dim]).astype(np.float64)


@dataclass(frozen=True)
class Scale:
    """How one entry of the statistics scales; ``low`` and ``high`` are mean and std, or a range.

    Args:
        norm: one of ``NORM_TYPES``.
        low, high: ``(D,)``, or ``(T, D)`` where each step has its own.
    """

    norm: str
    low: Floats
    high: Floats

    @property
    def dim(self) -> int:
        return int(self.low.shape[-1])

    def forward(self, values: npt.ArrayLike, what: str) -> Floats:
        """Physical ``(..., D)`` -> normalised.

        Raises:
            DataError: the width, or the number of steps, is another one.
        """
        x = np.asarray(values, np.float32)
        if x.ndim == 0 or x.shape[x.ndim - self.low.ndim :] != self.low.shape:
            raise DataError(
                f"SmolVLANormalize: {what} have shape {x.shape}, the statistics {self.low.shape}",
                cause="the statistics belong to another dataset or robot, or to another horizon",
            )
        if self.norm == "none":
            return x
        if self.norm == "mean_std":
            return (x - self.low) / (self.high + np.float32(EPS))
        return 2 * (x - self.low) / self._range() - 1

    def inverse(self, values: Floats) -> Floats:
        """Normalised ``(T, D)`` -> physical."""
        if self.norm == "none":
            return values
        if self.norm == "mean_std":
            return values * self.high + self.low
        return (values + 1) / 2 * self._range() + self.low

    def _range(self) -> Floats:
        size = self.high - self.low
        return np.where(size == 0, np.float32(EPS), size)


def make_scale(stats: Any, key: str, norm: str) -> Scale:
    """The scale by ``stats[key]``.

    Raises:
        ConfigError: it is missing, is no table of finite numbers, or of relative actions.
    """
    if not isinstance(stats, Mapping) or not isinstance(stats.get(key), Mapping):
        have = ", ".join(sorted(stats)) if isinstance(stats, Mapping) and stats else "nothing"
        raise ConfigError(
            f"SmolVLANormalize: the statistics have no entry {key!r}; they have {have}",
            next="train on a dataset, which has statistics, or import a checkpoint with them",
        )
    entry = stats[key]
    if entry.get("relative") is not None:
        raise ConfigError(
            "SmolVLANormalize: the statistics are of relative actions, which SmolVLA has not",
            next="--set <ParquetDataset>.relative_actions=false",
        )
    names = RANGES.get(norm, ("mean", "std"))
    missing = [name for name in names if name not in entry]
    if missing:
        raise ConfigError(
            f"SmolVLANormalize: the statistics {key!r} have no {missing[0]!r}; they have "
            f"{', '.join(sorted(entry))}"
        )
    low, high = (np.asarray(entry[name], np.float32) for name in names)
    if low.shape != high.shape or low.ndim not in (1, 2) or not _finite(low, high):
        raise ConfigError(
            f"SmolVLANormalize: {names[0]!r} {low.shape} and {names[1]!r} {high.shape} of the "
            f"statistics {key!r} are not finite numbers, one for each dimension"
        )
    return Scale(norm, low, high)


def _finite(*arrays: Floats) -> bool:
    return all(bool(np.isfinite(array).all()) for array in arrays)


def _pad(values: Floats, width: int, what: str) -> Floats:
    have = values.shape[-1]
    if have > width:
        raise ConfigError(
            f"SmolVLANormalize: {what} {width} would cut the data's {have} dimensions",
            next=f"make the model's max_{what} and this {what} {have} or more",
        )
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, width - have)])
