"""Action chunks by flow matching, with the network predicting the chunk itself.

The path is linear, ``x_t = (1 - t) * noise + t * actions`` with t from 0 to 1 (Lipman et al. 2023;
Liu et al. 2023). The network answers with an estimate of ``actions``, from which the velocity is
``(estimate - x_t) / (1 - t)``. Its squared error is the velocity's, weighted by ``(1 - t)^2``:
near t = 0 that is plain regression, so few noise samples each are enough, and the last
integration step lands on the estimate.
"""

from __future__ import annotations

import math
from functools import partial

import torch
from torch import Tensor, nn
from torch.nn import functional

from fluxvla_models.guidance import Guide
from fluxvla_models.widths import check_actions


class FlowBlock(nn.Module):
    """Residual MLP with adaptive layer normalisation (Peebles and Xie 2023)."""

    def __init__(self, width: int, context_dim: int, expand: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width, elementwise_affine=False)
        self.modulate = nn.Linear(context_dim, 2 * width)
        self.mlp = nn.Sequential(
            nn.Linear(width, expand * width), nn.GELU(), nn.Linear(expand * width, width)
        )

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        scale, shift = self.modulate(condition).chunk(2, dim=-1)
        return x + self.mlp(self.norm(x) * (1 + scale) + shift)


class FlowMatchingHead(nn.Module):
    """Context vector to action chunk.

    Args:
        horizon: actions in a chunk.
        action_dim: length of a (padded) action.
        context_dim: width of the context vector; the model fills it in.
        width, blocks, expand: size of the residual MLP.
        num_steps: Euler steps from noise to actions at inference.
        time_features: sines (and as many cosines) that stand for the time.
    """

    def __init__(
        self,
        horizon: int,
        action_dim: int,
        context_dim: int | None = None,
        width: int = 384,
        blocks: int = 3,
        expand: int = 2,
        num_steps: int = 5,
        time_features: int = 64,
    ) -> None:
        super().__init__()
        if context_dim is None:
            raise ValueError(
                "FlowMatchingHead needs context_dim, the width of the projector's vector"
            )
        self.horizon, self.action_dim = horizon, action_dim
        self.num_steps, self.time_features = num_steps, time_features
        self.time = nn.Sequential(
            nn.Linear(2 * time_features, context_dim),
            nn.SiLU(),
            nn.Linear(context_dim, context_dim),
        )
        self.chunk_in = nn.Linear(horizon * action_dim, width)
        self.context_in = nn.Linear(context_dim, width)
        self.blocks = nn.ModuleList(FlowBlock(width, context_dim, expand) for _ in range(blocks))
        self.norm = nn.LayerNorm(width)
        self.chunk_out = nn.Linear(width, horizon * action_dim)

    def estimate(self, x: Tensor, time: Tensor, context: Tensor) -> Tensor:
        """The clean chunk ``(B, T, D)`` behind ``x`` ``(B, T, D)`` at ``time`` ``(B,)``."""
        angles = 100.0 * time[:, None] * self._frequencies(time)
        times = self.time(torch.cat([angles.sin(), angles.cos()], dim=-1))
        condition = functional.silu(context + times)
        hidden = self.chunk_in(x.flatten(1)) + self.context_in(context)
        for block in self.blocks:
            hidden = block(hidden, condition)
        return self.chunk_out(self.norm(hidden)).unflatten(1, (self.horizon, self.action_dim))

    def errors(
        self, context: Tensor, actions: Tensor, masks: Tensor, noise: Tensor, time: Tensor
    ) -> Tensor:
        """Squared errors of the estimate, ``(B * K, T, D)``, K noise samples each.

        The loss is the mean of all of them, padded ones counting as zero: a denominator that
        depended on the masks would make the gradient depend on how samples share batches.

        Args:
            context: ``(B, C)``.
            actions: ``(B, T, D)`` normalised.
            masks: ``(B, T)``, 0 beyond the end of an episode.
            noise: ``(B, K, T, D)`` standard normal; ``time``: ``(B, K)`` in 0..1.
        """
        check_actions("FlowMatchingHead", actions, (self.horizon, self.action_dim))
        repeats = noise.shape[1]
        clean = actions[:, None].expand(-1, repeats, -1, -1)
        mixed = torch.lerp(noise, clean, time[..., None, None])
        repeated = context[:, None].expand(-1, repeats, -1)
        estimate = self.estimate(mixed.flatten(0, 1), time.flatten(), repeated.flatten(0, 1))
        error = (estimate - clean.flatten(0, 1)).square()
        return error * masks.repeat_interleave(repeats, 0)[..., None]

    def loss(
        self, context: Tensor, actions: Tensor, masks: Tensor, noise: Tensor, time: Tensor
    ) -> Tensor:
        """The mean of :meth:`errors`."""
        return self.errors(context, actions, masks, noise, time).mean()

    def sample(self, context: Tensor, noise: Tensor, guide: Guide | None = None) -> Tensor:
        """Integrate from ``noise`` ``(B, T, D)`` to a chunk ``(B, T, D)`` by Euler steps.

        With ``guide`` to one that goes on from another; that takes a backward pass for each step.
        """
        x = noise
        for step in range(self.num_steps):
            share = step / self.num_steps
            time = torch.full((len(x),), share, device=x.device, dtype=x.dtype)
            # velocity / num_steps, with 1 - t = (num_steps - step) / num_steps
            if guide is None:
                x = x + (self.estimate(x, time, context) - x) / (self.num_steps - step)
                continue
            found, pull = guide.pull(partial(self.estimate, time=time, context=context), x, share)
            x = x + (found - x) / (self.num_steps - step) + pull / self.num_steps
        return x if guide is None else guide.freeze(x)

    def fsdp_units(self) -> list[nn.Module]:
        """Blocks to shard one by one."""
        return list(self.blocks)

    def _frequencies(self, like: Tensor) -> Tensor:
        steps = torch.arange(self.time_features, device=like.device, dtype=torch.float32)
        return torch.exp(-math.log(1e3) * steps / self.time_features)
