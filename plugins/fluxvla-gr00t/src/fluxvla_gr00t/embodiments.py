"""Layers with weights for each kind of robot: what reads states and actions, and writes actions."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional


class EmbodimentLinear(nn.Module):
    """A linear layer for each embodiment: ``weight`` ``(E, in, out)``, ``bias`` ``(E, out)``."""

    def __init__(self, embodiments: int, in_dim: int, out_dim: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.randn(embodiments, in_dim, out_dim) * 0.02)
        self.bias = nn.Parameter(torch.zeros(embodiments, out_dim))

    def forward(self, x: Tensor, ids: Tensor) -> Tensor:
        """``x`` ``(B, T, in)`` with the weights of ``ids`` ``(B,)`` int64 -> ``(B, T, out)``."""
        return torch.bmm(x, self.weight[ids]) + self.bias[ids].unsqueeze(1)


class EmbodimentMLP(nn.Module):
    """Two layers for each embodiment, with a ReLU between them."""

    def __init__(self, embodiments: int, in_dim: int, hidden_dim: int, out_dim: int) -> None:
        super().__init__()
        self.hidden = EmbodimentLinear(embodiments, in_dim, hidden_dim)
        self.out = EmbodimentLinear(embodiments, hidden_dim, out_dim)

    def forward(self, x: Tensor, ids: Tensor) -> Tensor:
        """``x`` ``(B, T, in)``, ``ids`` ``(B,)`` -> ``(B, T, out)``."""
        return self.out(functional.relu(self.hidden(x, ids)), ids)


class ActionEncoder(nn.Module):
    """Noisy actions and their time -> tokens, with layers for each embodiment."""

    def __init__(self, embodiments: int, action_dim: int, width: int) -> None:
        super().__init__()
        self.width = width
        self.actions = EmbodimentLinear(embodiments, action_dim, width)
        self.joined = EmbodimentLinear(embodiments, 2 * width, width)
        self.out = EmbodimentLinear(embodiments, width, width)

    def forward(self, actions: Tensor, steps: Tensor, ids: Tensor) -> Tensor:
        """``actions`` ``(B, T, D)``, ``steps`` and ``ids`` ``(B,)`` int64 -> ``(B, T, W)``."""
        tokens = self.actions(actions, ids)
        waves = self._waves(steps).to(tokens.dtype)[:, None].expand_as(tokens)
        hidden = functional.silu(self.joined(torch.cat([tokens, waves], dim=-1), ids))
        return self.out(hidden, ids)

    def _waves(self, steps: Tensor) -> Tensor:
        half = self.width // 2
        powers = torch.arange(half, device=steps.device, dtype=torch.float32)
        angles = steps[:, None].float() * torch.exp(-powers * (math.log(10000.0) / half))
        return torch.cat([angles.sin(), angles.cos()], dim=-1)
