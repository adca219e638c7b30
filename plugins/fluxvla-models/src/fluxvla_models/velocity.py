"""Flow matching from noise at t = 1 to actions at t = 0 by a network that predicts the velocity.

pi0 and SmolVLA count time so: the path is ``x_t = t * noise + (1 - t) * actions``, its velocity
``noise - actions`` (Lipman et al. 2023). Elsewhere in FluxVLA time runs the other way; a batch's
``time`` is ``1 - t``.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from fluxvla_models.guidance import Guide

Velocity = Callable[[Tensor, Tensor], Tensor]
"""``(B, T, D)`` at time t ``(B,)`` -> the velocity there, ``(B, T, D)``."""


def sample(velocity: Velocity, noise: Tensor, steps: int, guide: Guide | None = None) -> Tensor:
    """Integrate from ``noise`` ``(B, T, D)`` to actions by Euler's method.

    With ``guide`` they continue an earlier chunk; that takes a backward pass for each step. Its
    chunk has the robot's own dimensions, at most D: those of the padding are not pulled, because a
    loss that leaves them out says nothing of them.
    """
    x = noise
    for step in range(steps):
        t = 1.0 - step / steps
        time = torch.full((len(x),), t, dtype=torch.float32, device=x.device)
        if guide is None:
            x = x - velocity(x, time) / steps
            continue
        found, pull = _guided(velocity, x, time, step / steps, guide)
        x = x + (pull - found) / steps
    if guide is None:
        return x
    own = guide.actions.shape[-1]
    return torch.cat([guide.freeze(x[..., :own]), x[..., own:]], dim=-1)


def _guided(
    velocity: Velocity, x: Tensor, time: Tensor, share: float, guide: Guide
) -> tuple[Tensor, Tensor]:
    """The velocity at ``x``, and how ``guide`` pulls after this ``share`` of the steps."""
    found: list[Tensor] = []

    def clean(x: Tensor) -> Tensor:
        found.append(velocity(x, time))
        return (x - time[:, None, None] * found[-1])[..., : guide.actions.shape[-1]]

    _, pull = guide.pull(clean, x, share)
    return found[-1].detach(), pull


def sinusoids(time: Tensor, width: int, shortest: float, longest: float) -> Tensor:
    """``(B,)`` -> ``(B, width)`` float64: sines, then cosines, of ``time`` at ``width / 2`` periods
    from ``shortest`` to ``longest``, spaced evenly on a logarithmic scale."""
    share = torch.linspace(0.0, 1.0, width // 2, dtype=torch.float64, device=time.device)
    periods = shortest * (longest / shortest) ** share
    angles = 1.0 / periods * 2 * math.pi * time[:, None]
    return torch.cat([angles.sin(), angles.cos()], dim=1)
