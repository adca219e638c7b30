"""Optimizers and learning-rate schedules that a config can name; imports no torch by itself.

A class of ``fluxvla.optimizers`` holds an optimizer's own settings and has
``build(groups, learning_rate) -> torch.optim.Optimizer``. ``groups`` are ``decay_groups`` of the
model: weight decay is already where it belongs. What is built has ``learning_rate``, or groups with
rates of their own; the schedule scales them all alike.

A schedule gives the learning rate as a function of the optimizer steps already done (0 gives the
rate of the first one), so that resuming needs only the step.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from fluxvla_core.contracts.training import Optimizer
from fluxvla_core.errors import ConfigError

if TYPE_CHECKING:
    import torch


class AdamW(Optimizer):
    """Adam with decoupled weight decay (Loshchilov and Hutter 2019), in one fused kernel.

    Args:
        betas: decay of the two running means.
        eps: added to the denominator.
        fused: one kernel for all parameters (CPU and CUDA have one); False is torch's foreach.
    """

    def __init__(
        self, betas: Sequence[float] = (0.9, 0.999), eps: float = 1e-8, fused: bool = True
    ) -> None:
        self.betas, self.eps, self.fused = (betas[0], betas[1]), eps, fused

    def build(self, groups: list[dict[str, Any]], learning_rate: float) -> torch.optim.Optimizer:
        """The optimizer over ``groups``."""
        import torch

        return torch.optim.AdamW(
            groups,
            lr=learning_rate,
            betas=self.betas,
            eps=self.eps,
            fused=self.fused or None,
            foreach=None if self.fused else True,
        )


class SGD(Optimizer):
    """Stochastic gradient descent.

    Args:
        momentum: of the running mean of gradients; 0 keeps none.
        nesterov: look ahead by that mean.
    """

    def __init__(self, momentum: float = 0.9, nesterov: bool = False) -> None:
        self.momentum, self.nesterov = momentum, nesterov

    def build(self, groups: list[dict[str, Any]], learning_rate: float) -> torch.optim.Optimizer:
        """The optimizer over ``groups``."""
        import torch

        return torch.optim.SGD(
            groups, lr=learning_rate, momentum=self.momentum, nesterov=self.nesterov, foreach=True
        )


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


class ScheduledLR:
    """Sets every group's rate to ``schedule(step)``, as torch's schedulers do; keeps only the step.

    A group that the optimizer was built with at a multiple of ``learning_rate`` keeps to it.
    """

    def __init__(
        self, optimizer: torch.optim.Optimizer, schedule: Schedule, learning_rate: float
    ) -> None:
        self.optimizer, self.schedule, self.last_epoch = optimizer, schedule, 0
        for group in optimizer.param_groups:
            group.setdefault("initial_lr", group["lr"])
        bases = [float(group["initial_lr"]) for group in optimizer.param_groups]
        self._multiples = [base / learning_rate for base in bases]
        self._set_rates()

    def step(self) -> None:
        """Set the rates of the next step."""
        self.last_epoch += 1
        self._set_rates()

    def state_dict(self) -> dict[str, Any]:
        """The step."""
        return {"step": self.last_epoch}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """The inverse of :meth:`state_dict`."""
        self.last_epoch = state_dict["step"]
        self._set_rates()

    def _set_rates(self) -> None:
        rate = self.schedule(self.last_epoch)
        for group, multiple in zip(self.optimizer.param_groups, self._multiples, strict=True):
            group["lr"] = rate * multiple
