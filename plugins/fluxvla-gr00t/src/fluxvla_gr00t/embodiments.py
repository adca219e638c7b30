"""Layers with weights for each embodiment: encoders of states and actions, action decoder."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional

Chosen = tuple[Tensor, Tensor]
"""Weights and biases of the samples' embodiments."""


class EmbodimentLinear(nn.Module):
    """A linear layer for each embodiment: ``weight`` ``(E, in, out)``, ``bias`` ``(E, out)``."""

    def __init__(self, embodiments: int, in_dim: int, out_dim: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.randn(embodiments, in_dim, out_dim) * 0.02)
        self.bias = nn.Parameter(torch.zeros(embodiments, out_dim))

    def forward(self, x: Tensor, ids: Tensor) -> Tensor:
        """``x`` ``(B, T, in)`` with the weights of ``ids`` ``(B,)`` int64 -> ``(B, T, out)``."""
        return applied(x, self.chosen(ids))

    def chosen(self, ids: Tensor) -> Chosen:
        """The weights ``(B, in, out)`` and biases ``(B, 1, out)`` of ``ids`` ``(B,)``."""
        return self.weight[ids], self.bias[ids].unsqueeze(1)


def applied(x: Tensor, chosen: Chosen) -> Tensor:
    """``x`` ``(B, T, in)`` -> ``(B, T, out)``."""
    weight, bias = chosen
    return torch.bmm(x, weight) + bias


class EmbodimentMLP(nn.Module):
    """Two layers for each embodiment, with a ReLU between them."""

    def __init__(self, embodiments: int, in_dim: int, hidden_dim: int, out_dim: int) -> None:
        super().__init__()
        self.hidden = EmbodimentLinear(embodiments, in_dim, hidden_dim)
        self.out = EmbodimentLinear(embodiments, hidden_dim, out_dim)

    def forward(self, x: Tensor, ids: Tensor) -> Tensor:
        """``x`` ``(B, T, in)``, ``ids`` ``(B,)`` -> ``(B, T, out)``."""
        return self.of(x, {"hidden": self.hidden.chosen(ids), "out": self.out.chosen(ids)})

    def of(self, x: Tensor, chosen: Mapping[str, Chosen]) -> Tensor:
        """As ``forward``, with weights that were chosen before."""
        return applied(functional.relu(applied(x, chosen["hidden"])), chosen["out"])


class ActionEncoder(nn.Module):
    """Noisy actions and their time -> tokens, with layers for each embodiment."""

    def __init__(self, embodiments: int, action_dim: int, width: int) -> None:
        super().__init__()
        self.width = width
        self.actions = EmbodimentLinear(embodiments, action_dim, width)
        self.joined = EmbodimentLinear(embodiments, 2 * width, width)
        self.out = EmbodimentLinear(embodiments, width, width)

    def forward(self, actions: Tensor, steps: Tensor, ids: Tensor) -> Tensor:
        """``actions`` ``(B, T, D)``, ``ids`` ``(B,)`` int64 -> ``(B, T, W)``.

        ``steps`` are ``(B,)`` int64, or ``(B, T)``: one for each action.
        """
        chosen = {name: part.chosen(ids) for name, part in self.named_children()}
        waves = self.waves(steps if steps.ndim == 2 else steps[:, None])
        return self.of(actions, waves, chosen)

    def of(self, actions: Tensor, waves: Tensor, chosen: Mapping[str, Chosen]) -> Tensor:
        """As ``forward``, with weights and ``waves``, broadcast to tokens, from before."""
        tokens = applied(actions, chosen["actions"])
        joined = torch.cat([tokens, waves.to(tokens.dtype).expand_as(tokens)], dim=-1)
        return applied(functional.silu(applied(joined, chosen["joined"])), chosen["out"])

    def waves(self, steps: Tensor) -> Tensor:
        """Sinusoidal features ``(..., W)`` float32 of the time steps ``(...)``."""
        half = self.width // 2
        powers = torch.arange(half, device=steps.device, dtype=torch.float32)
        angles = steps[..., None].float() * torch.exp(-powers * (math.log(10000.0) / half))
        return torch.cat([angles.sin(), angles.cos()], dim=-1)
