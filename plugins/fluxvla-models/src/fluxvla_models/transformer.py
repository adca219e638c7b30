"""Transformer layers that add positions to queries and keys, as in DETR (Carion et al. 2020).

Everything is batch first: ``(B, L, C)``. Parameters are named as in ACT's implementations.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional

from fluxvla_core.errors import ConfigError

ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "relu": functional.relu,
    "gelu": functional.gelu,
}


class FeedForward(nn.Module):
    """Base class of encoder and decoder layers; its parameters have the layer's own names."""

    def __init__(
        self, width: int, hidden: int, dropout: float, activation: str, pre_norm: bool
    ) -> None:
        super().__init__()
        if activation not in ACTIVATIONS:
            raise ConfigError(f"activation {activation!r} is not one of {', '.join(ACTIVATIONS)}")
        self.linear1 = nn.Linear(width, hidden)
        self.linear2 = nn.Linear(hidden, width)
        self.activation = ACTIVATIONS[activation]
        self.pre_norm = pre_norm
        self.dropout = nn.Dropout(dropout)

    def residual(self, x: Tensor, norm: nn.Module, sublayer: Callable[[Tensor], Tensor]) -> Tensor:
        """``x`` and what ``sublayer`` makes of it, normalised before or after."""
        if self.pre_norm:
            return x + self.dropout(sublayer(norm(x)))
        return norm(x + self.dropout(sublayer(x)))

    def feed(self, x: Tensor) -> Tensor:
        return self.linear2(self.dropout(self.activation(self.linear1(x))))


class EncoderLayer(FeedForward):
    """Self-attention and an MLP."""

    def __init__(
        self,
        width: int,
        heads: int,
        hidden: int,
        dropout: float = 0.0,
        activation: str = "relu",
        pre_norm: bool = False,
    ) -> None:
        super().__init__(width, hidden, dropout, activation, pre_norm)
        self.self_attn = nn.MultiheadAttention(width, heads, dropout, batch_first=True)
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)

    def forward(self, x: Tensor, positions: Tensor, ignored: Tensor | None = None) -> Tensor:
        """``x`` ``(B, L, C)``; ``positions`` ``(1 or B, L, C)``; ``ignored`` ``(B, L)`` bool."""

        def attend(y: Tensor) -> Tensor:
            where = y + positions
            return self.self_attn(where, where, y, key_padding_mask=ignored, need_weights=False)[0]

        return self.residual(self.residual(x, self.norm1, attend), self.norm2, self.feed)


class Encoder(nn.Module):
    """Encoder layers, with a last normalisation where each begins with one."""

    def __init__(self, layers: int, width: int, heads: int, hidden: int, **more: object) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            EncoderLayer(width, heads, hidden, **more) for _ in range(layers)
        )
        self.norm = nn.LayerNorm(width) if more.get("pre_norm") else nn.Identity()

    def forward(self, x: Tensor, positions: Tensor, ignored: Tensor | None = None) -> Tensor:
        for layer in self.layers:
            x = layer(x, positions, ignored)
        return self.norm(x)


class DecoderLayer(FeedForward):
    """Self-attention, attention to the encoder's result, and an MLP."""

    def __init__(
        self,
        width: int,
        heads: int,
        hidden: int,
        dropout: float = 0.0,
        activation: str = "relu",
        pre_norm: bool = False,
    ) -> None:
        super().__init__(width, hidden, dropout, activation, pre_norm)
        self.self_attn = nn.MultiheadAttention(width, heads, dropout, batch_first=True)
        self.multihead_attn = nn.MultiheadAttention(width, heads, dropout, batch_first=True)
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.norm3 = nn.LayerNorm(width)

    def forward(
        self,
        x: Tensor,
        memory: Tensor,
        positions: Tensor,
        memory_positions: Tensor,
        ignored: Tensor | None = None,
    ) -> Tensor:
        """``x`` ``(B, T, C)``, ``memory`` ``(B, L, C)``, the positions of both, and what of
        ``memory`` is ignored, ``(B, L)`` bool."""

        def attend(y: Tensor) -> Tensor:
            where = y + positions
            return self.self_attn(where, where, y, need_weights=False)[0]

        def look(y: Tensor) -> Tensor:
            keys = memory + memory_positions
            return self.multihead_attn(
                y + positions, keys, memory, key_padding_mask=ignored, need_weights=False
            )[0]

        x = self.residual(x, self.norm1, attend)
        x = self.residual(x, self.norm2, look)
        return self.residual(x, self.norm3, self.feed)


class Decoder(nn.Module):
    """Decoder layers and a last normalisation."""

    def __init__(self, layers: int, width: int, heads: int, hidden: int, **more: object) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            DecoderLayer(width, heads, hidden, **more) for _ in range(layers)
        )
        self.norm = nn.LayerNorm(width)

    def forward(
        self,
        x: Tensor,
        memory: Tensor,
        positions: Tensor,
        memory_positions: Tensor,
        ignored: Tensor | None = None,
    ) -> Tensor:
        for layer in self.layers:
            x = layer(x, memory, positions, memory_positions, ignored)
        return self.norm(x)


def positions_1d(length: int, width: int, device: torch.device) -> Tensor:
    """Sines at even and cosines at odd places, ``(1, length, width)`` (Vaswani et al. 2017)."""
    place = torch.arange(length, dtype=torch.float64)[:, None]
    index = torch.arange(width, dtype=torch.float64)
    angles = place / 10000.0 ** (2 * (index // 2) / width)
    table = torch.where(index % 2 == 0, angles.sin(), angles.cos())
    return table[None].to(device=device, dtype=torch.float32)


def positions_2d(height: int, width: int, channels: int, device: torch.device) -> Tensor:
    """Positions of an image's rows and columns, ``(1, height * width, channels)``.

    Half of the channels say the row, half the column, each counted from 1 and scaled to 0..2 pi
    (DETR's, Carion et al. 2020, appendix A.4).
    """
    half = channels // 2
    index = torch.arange(half, dtype=torch.float32, device=device)
    periods = 10000.0 ** (2 * (index // 2) / half)
    even = index % 2 == 0

    def waves(length: int) -> Tensor:
        place = torch.arange(1, length + 1, dtype=torch.float32, device=device)
        angles = (place / (length + 1e-6) * (2 * math.pi))[:, None] / periods
        return torch.where(even, angles.sin(), angles.cos())

    rows = waves(height)[:, None].expand(height, width, half)
    columns = waves(width)[None].expand(height, width, half)
    return torch.cat([rows, columns], dim=-1).reshape(1, height * width, channels)
