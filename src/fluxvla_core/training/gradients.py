"""Gradient norm and clipping over all ranks."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from fluxvla_core.checkpoints.tensors import full_tensor


def gradient_norm(parameters: list[nn.Parameter]) -> Tensor:
    """The norm of all gradients over all ranks, a scalar on the device."""
    return full_tensor(
        torch.nn.utils.get_total_norm([p.grad for p in parameters if p.grad is not None])
    )


def clip_(parameters: list[nn.Parameter], max_norm: float) -> Tensor:
    """Scale gradients in place so that their norm over all ranks is at most ``max_norm``.

    Returns:
        The norm before, a scalar on the device.
    """
    # Gathered once, here: torch.nn.utils.clip_grad_norm_ would do it again for the caller.
    norm = gradient_norm(parameters)
    torch.nn.utils.clip_grads_with_norm_(parameters, max_norm, norm)
    return norm
