"""Learning rate as a function of the step, so that resuming needs only the step.

``step`` counts optimizer steps already done: 0 gives the rate of the first one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from fluxvla_core.errors import ConfigError

Schedule = Callable[[int], float]
TYPES = ("constant", "linear-warmup+cosine-decay", "step-based", "wsd")
WSD_DECAY = 0.2
"""Last part of a WSD run that decays, 1 - sqrt (Haegele et al. 2024, arXiv 2405.18392)."""


def make_schedule(
    kind: str,
    learning_rate: float,
    total_steps: int,
    warmup_ratio: float = 0.0,
    lr_schedule: Mapping[Any, float] | None = None,
) -> Schedule:
    """Step -> learning rate.

    Args:
        kind: ``constant``; ``linear-warmup+cosine-decay`` (to 0 at ``total_steps``);
            ``step-based`` (the rates of ``lr_schedule``); ``wsd`` (warm-up, stable, decay to 0
            over the last fifth).
        learning_rate: peak rate; ``step-based`` does not use it.
        warmup_ratio: part of ``total_steps`` (``W`` steps) over which the rate rises linearly: step
            ``k``, counted from 0, has ``learning_rate * (k + 1) / W``.
        lr_schedule: for ``step-based``: part of the run done -> rate from there on; has 0.

    Raises:
        ConfigError: an unknown kind, a ratio out of 0..1, ``lr_schedule`` without 0 or with a
            rate that is negative or no number.
    """
    if kind not in TYPES:
        listed = ", ".join(map(repr, TYPES))
        raise ConfigError(f"unknown lr_scheduler_type {kind!r}; choose one of {listed}")
    if not 0.0 <= warmup_ratio < 1.0:
        raise ConfigError(f"warmup_ratio must be at least 0 and below 1, got {warmup_ratio}")
    if (kind == "step-based") != (lr_schedule is not None):
        raise ConfigError(
            "lr_schedule belongs to lr_scheduler_type 'step-based', and that needs it "
            "(for example {0: 1e-4, 0.8: 1e-5})"
        )
    if lr_schedule is not None:
        if warmup_ratio:
            raise ConfigError("'step-based' has no warm-up: write it into lr_schedule instead")
        return _stepped(lr_schedule, total_steps)
    warmup = round(warmup_ratio * total_steps)
    shape: Callable[[int], float] = {
        "constant": lambda step: 1.0,
        "linear-warmup+cosine-decay": lambda step: _cosine(step - warmup, total_steps - warmup),
        "wsd": lambda step: _wsd(step, total_steps, warmup),
    }[kind]

    def rate(step: int) -> float:
        if step < warmup:
            return learning_rate * (step + 1) / warmup
        return learning_rate * shape(step)

    return rate


def _cosine(step: int, total: int) -> float:
    return 0.5 * (1.0 + math.cos(math.pi * min(1.0, step / max(1, total))))


def _wsd(step: int, total: int, warmup: int) -> float:
    decay = min(round(WSD_DECAY * total), total - warmup)
    begin = total - decay
    return 1.0 if step < begin else max(0.0, 1.0 - math.sqrt((step - begin) / max(1, decay)))


def _stepped(table: Mapping[Any, float], total: int) -> Schedule:
    # JSON and TOML have only strings for keys.
    try:
        points = sorted((float(ratio), float(lr)) for ratio, lr in table.items())
    except (TypeError, ValueError) as error:
        raise ConfigError(f"lr_schedule maps ratios to rates, got {dict(table)!r}") from error
    if not points or points[0][0] != 0.0 or points[-1][0] > 1.0:
        raise ConfigError(
            f"lr_schedule needs ratios from 0 to 1 with 0 among them, got {[p[0] for p in points]}"
        )
    if not all(math.isfinite(lr) and lr >= 0 for _, lr in points):
        raise ConfigError(f"lr_schedule needs rates from 0 up, got {[p[1] for p in points]}")

    def rate(step: int) -> float:
        # 0.07 * 100 is a little more than 7.
        return next(lr for ratio, lr in reversed(points) if step >= round(ratio * total, 6))

    return rate
