"""Flow matching from noise at t = 1 to actions at t = 0, as pi0 and SmolVLA count time.

The path is ``x_t = t * noise + (1 - t) * actions``, its velocity ``noise - actions`` (Lipman et al.
2023). Elsewhere in FluxVLA time runs the other way; a batch's ``time`` is ``1 - t``.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from fluxvla_models.guidance import Guide
from torch import Tensor

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


def masked_mean(errors: Tensor, masks: Tensor, over: str) -> tuple[Tensor, Tensor]:
    """The loss of a batch, and that of each sample, ``(B,)``.

    Args:
        errors: ``(B, K, T, D)``.
        masks: ``(B, T)``, 0 beyond the end of an episode.
        over: ``valid``: the mean over steps inside episodes; ``all``: the others count as 0, so
            that the gradient does not depend on which samples share a batch.
    """
    kept = errors * masks[:, None, :, None]
    if over == "all":
        return kept.mean(), kept.flatten(1).mean(1)
    each = masks.sum(1).to(errors.dtype) * errors.shape[1] * errors.shape[3]
    return kept.sum() / each.sum().clamp_min(1), kept.flatten(1).sum(1) / each.clamp_min(1)
