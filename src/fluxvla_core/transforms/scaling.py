"""The one definition of normalisation; both directions come from it, so they cannot drift apart.

A value ``x`` becomes ``(x - offset) / scale``. ``relative`` in a statistics entry marks dimensions
that are counted from the present state; they are shifted by it before and after.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import ConfigError

Floats = npt.NDArray[np.float64]

_RANGES = {"quantile": ("q01", "q99"), "min_max": ("min", "max")}
NORM_TYPES = ("mean_std", *_RANGES, "none")
EPS = 1e-6


@dataclass(frozen=True)
class Affine:
    """``offset`` and ``scale`` are ``(D,)`` or ``(T, D)``, ``relative`` is ``(D,)`` of 0 and 1."""

    offset: Floats
    scale: Floats
    relative: Floats | None = None

    @property
    def dim(self) -> int:
        return int(self.offset.shape[-1])

    def forward(self, values: npt.ArrayLike, state: npt.ArrayLike | None = None) -> Floats:
        """Physical ``(..., D)`` -> normalised ``(..., D)``, in float64."""
        return (np.asarray(values, np.float64) - self._base(state) - self.offset) / self.scale

    def inverse(self, values: npt.ArrayLike, state: npt.ArrayLike | None = None) -> Floats:
        """Normalised ``(..., D)`` -> physical ``(..., D)``, in float64."""
        return np.asarray(values, np.float64) * self.scale + self.offset + self._base(state)

    def _base(self, state: npt.ArrayLike | None) -> Floats | float:
        if self.relative is None:
            return 0.0
        if state is None:
            raise ConfigError(
                "these actions are counted from the present state, and no state was given",
                next="pass the state in physical units as data['states']",
            )
        base: Floats = np.asarray(state, np.float64).reshape(-1)[: self.dim] * self.relative
        return base


def check_norm_type(norm_type: str, who: str) -> None:
    """Refuse a name that means nothing.

    Raises:
        ConfigError: with the names there are and the nearest one.
    """
    if norm_type in NORM_TYPES:
        return
    near = difflib.get_close_matches(str(norm_type), NORM_TYPES, 1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    raise ConfigError(
        f"{who}: norm_type {norm_type!r} is none of {', '.join(NORM_TYPES)}{hint}",
        cause="state_key and action_key select the statistics, norm_type the formula",
    )


def make_affine(
    stats: Mapping[str, Any],
    norm_type: str,
    who: str,
    std_floor: float = 0.0,
    norm_mask: Sequence[bool] | None = None,
) -> Affine:
    """Offset and scale from one statistics entry.

    Args:
        stats: ``mean``, ``std``, ``min``, ``max``, ``q01``, ``q99``: ``(D,)`` or ``(T, D)``;
            optionally ``relative`` ``(D,)``.
        norm_type: ``mean_std``: (x - mean) / (std + 1e-6); ``quantile`` and ``min_max``:
            2 (x - low) / (high - low + 1e-6) - 1; ``none``: x.
        std_floor: no dimension is divided by less than this, in the data's units: a joint that
            hardly moved in the demonstrations otherwise turns noise into huge values.
        norm_mask: ``(D,)``; False leaves a dimension as it is.

    Raises:
        ConfigError: a statistic is missing, or the mask has another length.
    """
    mean = _entry(stats, "mean", who)
    if norm_type == "none":
        offset, scale = np.zeros_like(mean), np.ones_like(mean)
    elif norm_type == "mean_std":
        offset, scale = mean, np.maximum(_entry(stats, "std", who), std_floor) + EPS
    else:
        low, high = (_entry(stats, name, who) for name in _RANGES[norm_type])
        scale = np.maximum((high - low + EPS) / 2, std_floor)
        offset = _center(low, high, scale)
    if norm_mask is not None:
        mask = np.asarray(norm_mask, bool)
        if mask.shape != offset.shape[-1:]:
            raise ConfigError(
                f"{who}: action_norm_mask has {mask.size} entries, "
                f"the statistics have {offset.shape[-1]}"
            )
        offset, scale = np.where(mask, offset, 0.0), np.where(mask, scale, 1.0)
    relative = stats.get("relative")
    return Affine(offset, scale, None if relative is None else np.asarray(relative, np.float64))


def _center(low: Floats, high: Floats, scale: Floats) -> Floats:
    """``low`` maps to -1 unless the floor widened the range; then its middle maps to 0."""
    widened = scale > (high - low + EPS) / 2
    return np.where(widened, (low + high) / 2, low + scale)


def _entry(stats: Mapping[str, Any], name: str, who: str) -> Floats:
    if name not in stats:
        raise ConfigError(
            f"{who}: the statistics have no {name!r}; they have {', '.join(sorted(stats))}"
        )
    return np.asarray(stats[name], np.float64)
