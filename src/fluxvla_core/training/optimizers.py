"""Optimizers that a config can name: ``optimizer = dict(type="AdamW", betas=(0.9, 0.95))``.

A class of ``fluxvla.optimizers`` holds an optimizer's own settings and has
``build(groups, learning_rate) -> torch.optim.Optimizer``. ``groups`` are ``decay_groups`` of the
model: weight decay is already where it belongs. What is built has ``learning_rate``, or groups with
rates of their own; the schedule scales them all alike. Constructors import no torch, so that a
config is checked without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from fluxvla_core.contracts.training import Optimizer

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
