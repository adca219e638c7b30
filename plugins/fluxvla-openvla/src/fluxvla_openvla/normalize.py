"""States and actions as OpenVLA's code normalises them, and the noise of its diffusion head.

``2 (x - low) / (high - low + 1e-8) - 1``, clipped to -1..1. Dimensions that the statistics mask
(``mask``: the gripper, which is open or closed) stay as they are, and those that never moved in the
data are 0. Source: ``normalize_action_and_proprio`` of openvla-oft.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core import RandomTransform, Transform
from fluxvla_core.errors import ConfigError

Floats = npt.NDArray[np.float64]
BOUNDS = {"quantile": ("q01", "q99"), "min_max": ("min", "max")}
GRIPPERS = ("libero",)
_EPS = 1e-8


class NormalizeOpenVLA(Transform):
    """Normalise ``actions`` ``(T, D)`` where there are any and, if asked, ``states`` ``(S,)``.

    The statistics are ``sample["stats"]["action"]`` and ``["proprio"]``; ``mask`` of the former
    is what ``action_mask`` is if it is not given.

    Args:
        bounds: ``quantile`` (q01 and q99, LIBERO) or ``min_max`` (ALOHA).
        states: normalise states too; OpenVLA has none, OpenVLA-OFT has.
        action_mask: ``(D,)``; False leaves a dimension as it is.
        gripper: ``libero``: the last dimension, -1 open and 1 closed in LIBERO's data, is 1 open
            and 0 closed for the model; acting, it is rounded to either and turned back.

    Raises:
        ConfigError: an unknown name, or statistics that are missing or of another width.
    """

    keeps_images = True

    def __init__(
        self,
        bounds: str = "quantile",
        states: bool = True,
        action_mask: Sequence[bool] | None = None,
        gripper: str | None = None,
    ) -> None:
        _check_names(type(self).__name__, bounds, gripper)
        self.bounds = bounds
        self.states = states
        self.action_mask = action_mask
        self.gripper = gripper

    def __call__(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """The sample with float32 states and actions."""
        out, stats = dict(sample), sample.get("stats")
        if self.states:
            row = Row.read(stats, "proprio", self.bounds, None)
            out["states"] = np.clip(row.forward(sample["states"]), -1.0, 1.0).astype(np.float32)
        if "actions" in sample:
            row = Row.read(stats, "action", self.bounds, self.action_mask)
            actions = np.array(sample["actions"], np.float64)
            row.check("actions", actions)
            if self.gripper:
                actions[..., -1] = 1.0 - np.clip(actions[..., -1], 0.0, 1.0)
            out["actions"] = row.forward(actions).astype(np.float32)
        return out

    def denormalizer(
        self, norm_stats: Mapping[str, Any], statistic_name: str = "private"
    ) -> DenormalizeOpenVLA:
        """The transform that undoes this one's actions."""
        return DenormalizeOpenVLA(
            norm_stats, self.bounds, self.action_mask, self.gripper, statistic_name
        )


class DenormalizeOpenVLA(Transform):
    """A model's actions in physical units: the inverse of ``NormalizeOpenVLA``.

    Called with ``{"action": (1, T, D) or (T, D)}``; returns ``(T, D)`` float64.

    Args:
        norm_stats: the statistics, as ``dataset_statistics.json`` has them.
        bounds, action_mask, gripper: as in training.
        statistic_name: which of the statistics (OpenVLA's ``unnorm_key``).

    Raises:
        ConfigError: no such statistics; lists those there are.
    """

    def __init__(
        self,
        norm_stats: Mapping[str, Any] | None = None,
        bounds: str = "quantile",
        action_mask: Sequence[bool] | None = None,
        gripper: str | None = None,
        statistic_name: str = "private",
    ) -> None:
        who = type(self).__name__
        _check_names(who, bounds, gripper)
        known = norm_stats or {}
        if statistic_name not in known:
            raise ConfigError(
                f"{who}: there are no statistics {statistic_name!r}; there are "
                f"{', '.join(map(repr, sorted(known))) or 'none'}",
                cause="OpenVLA calls this name unnorm_key: the dataset that it was trained on",
                next="set statistic_name to one of them",
            )
        self.gripper = gripper
        self._row = Row.read(known[statistic_name], "action", bounds, action_mask)

    def __call__(self, data: Mapping[str, Any]) -> Floats:  # type: ignore[override]  # no sample
        """``(T, D)`` float64."""
        action = np.asarray(data["action"], np.float64)
        if action.ndim == 3 and len(action) == 1:
            action = action[0]
        self._row.check("the model's actions", action)
        physical = self._row.inverse(action)
        if self.gripper:
            physical[..., -1] = np.where(physical[..., -1] > 0.5, -1.0, 1.0)
        return physical


class Row:
    """Lower and upper bound of each dimension, and which are normalised.

    Args:
        low, high: ``(D,)``; mask: ``(D,)`` bool; still: ``(D,)`` bool, never moved in the data.
    """

    def __init__(
        self,
        low: Floats,
        high: Floats,
        mask: npt.NDArray[np.bool_],
        still: npt.NDArray[np.bool_],
    ) -> None:
        self.low, self.high, self.mask, self.still = low, high, mask, still

    @classmethod
    def read(cls, stats: Any, key: str, bounds: str, mask: Sequence[bool] | None) -> Row:
        """The row of one entry of the statistics.

        Raises:
            ConfigError: something is missing, or rows have other lengths.
        """
        entry = stats.get(key) if isinstance(stats, Mapping) else None
        names = (*BOUNDS[bounds], *BOUNDS["min_max"])
        table = entry if isinstance(entry, Mapping) else {}
        lacks = [name for name in dict.fromkeys(names) if name not in table]
        if lacks:
            raise ConfigError(
                f"the statistics of {key!r} lack {', '.join(lacks)}; they have "
                f"{', '.join(sorted(table)) or 'nothing'}"
            )
        if entry.get("relative") is not None:
            raise ConfigError(
                f"the statistics of {key!r} count actions from the state (relative_actions), which "
                "NormalizeOpenVLA does not",
                next="train without relative_actions",
            )
        low, high, least, most = (_finite(entry[name], name, key) for name in names)
        chosen = mask if mask is not None else entry.get("mask", np.ones(low.shape, bool))
        used = np.asarray(chosen, bool)
        rows = dict(zip(names, (low, high, least, most), strict=True))
        sizes = {**{name: row.shape for name, row in rows.items()}, "mask": used.shape}
        if low.ndim != 1 or len(set(sizes.values())) > 1:
            listed = ", ".join(f"{math.prod(n)} in {name!r}" for name, n in sizes.items())
            raise ConfigError(
                f"the statistics of {key!r} are not rows of one length: {listed}",
                cause="the statistics or the mask belong to another robot",
            )
        return cls(low, high, used, least == most)

    def check(self, what: str, values: Floats) -> None:
        """Refuse ``values`` ``(..., D)`` of another width.

        Raises:
            ConfigError: with both widths.
        """
        if values.ndim == 0 or values.shape[-1] != len(self.low):
            raise ConfigError(
                f"{what} have shape {values.shape}, the statistics describe {len(self.low)} "
                "dimensions",
                cause="the statistics belong to another dataset or robot",
            )

    def forward(self, values: Any) -> Floats:
        """``(..., D)`` physical -> normalised."""
        values = np.asarray(values, np.float64)
        self.check("states or actions", values)
        scaled = 2 * (values - self.low) / (self.high - self.low + _EPS) - 1
        moved = np.where(self.mask, np.clip(scaled, -1.0, 1.0), values)
        return np.where(self.still, 0.0, moved)

    def inverse(self, values: Floats) -> Floats:
        """``(..., D)`` normalised -> physical."""
        scaled = 0.5 * (values + 1) * (self.high - self.low + _EPS) + self.low
        return np.where(self.mask, scaled, values)


class SampleDiffusionSteps(RandomTransform):
    """Add what the diffusion head learns from: ``noise`` ``(1, T, D)``, ``time`` ``(1,)`` int64.

    Args:
        num_steps: steps of the diffusion, the model's ``num_train_steps``.
    """

    training_only = True
    keeps_images = True

    def __init__(self, num_steps: int = 50) -> None:
        if num_steps < 1:
            raise ConfigError(f"SampleDiffusionSteps: num_steps must be at least 1: {num_steps}")
        self.num_steps = num_steps

    def __call__(self, sample: Mapping[str, Any], rng: np.random.Generator) -> dict[str, Any]:
        """The sample with normal noise and a step 0, 1, … drawn evenly."""
        noise = rng.standard_normal((1, *np.shape(sample["actions"])), dtype=np.float32)
        return {**sample, "noise": noise, "time": rng.integers(0, self.num_steps, 1)}


def _finite(row: Any, name: str, key: str) -> Floats:
    """``row`` as an array.

    Raises:
        ConfigError: it is not finite numbers.
    """
    try:
        found = np.asarray(row, np.float64)
    except (TypeError, ValueError):
        found = np.asarray(np.nan)
    if not np.isfinite(found).all():
        raise ConfigError(
            f"{name!r} of the statistics of {key!r} is {str(row)[:60]}; finite numbers are expected"
        )
    return found


def _check_names(who: str, bounds: str, gripper: str | None) -> None:
    if bounds not in BOUNDS:
        raise ConfigError(f"{who}: bounds {bounds!r} is not one of {', '.join(BOUNDS)}")
    if gripper is not None and gripper not in GRIPPERS:
        raise ConfigError(
            f"{who}: gripper {gripper!r} is not one of {', '.join(GRIPPERS)}, or None"
        )
