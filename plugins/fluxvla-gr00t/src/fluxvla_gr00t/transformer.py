"""The transformers of GR00T's action head: a diffusion transformer, and one over the context.

The diffusion transformer (DiT, Peebles and Xie 2023) takes the time through adaptive layer
normalisation. Its even blocks attend to the context, its odd ones to their own tokens. What each
number is (epsilons, order of sines and cosines, order of shift and scale) follows the published
models, whose weights are of use with these alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

_SINES = 256
_LONGEST = 10000.0


@dataclass
class KVCache:
    """KV cache: keys and values of a context, ``(B, heads, L, head_dim)``; None until computed.

    They do not depend on the noisy actions, so the steps of an integration share them.
    """

    key: Tensor | None = None
    value: Tensor | None = None


class Attention(nn.Module):
    """Multi-head attention of ``x`` ``(B, T, W)`` to itself or to ``context`` ``(B, L, C)``."""

    def __init__(self, width: int, context_dim: int, heads: int, head_dim: int) -> None:
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(width, heads * head_dim)
        self.key = nn.Linear(context_dim, heads * head_dim)
        self.value = nn.Linear(context_dim, heads * head_dim)
        self.out = nn.Linear(heads * head_dim, width)

    def forward(
        self, x: Tensor, context: Tensor, mask: Tensor | None = None, cache: KVCache | None = None
    ) -> Tensor:
        """``mask`` ``(B, L)``: bool, True where the context is attended to, or numbers that are
        added to the scores; None: all of it.

        ``cache``: keys and values of this same context ; it is filled if it is empty.
        """
        query = self._heads(self.query(x))
        if cache is None or cache.key is None or cache.value is None:
            key, value = self._heads(self.key(context)), self._heads(self.value(context))
            if cache is not None:
                cache.key, cache.value = key.detach(), value.detach()
        else:
            key, value = cache.key, cache.value
        attn_mask = None if mask is None else mask[:, None, None, :]
        mixed = functional.scaled_dot_product_attention(query, key, value, attn_mask=attn_mask)
        return self.out(mixed.transpose(1, 2).flatten(2))

    def cache_context(self, context: Tensor) -> KVCache:
        """The KV cache of ``context`` ``(B, L, C)``."""
        return KVCache(self._heads(self.key(context)), self._heads(self.value(context)))

    def _heads(self, x: Tensor) -> Tensor:
        return x.unflatten(-1, (self.heads, -1)).transpose(1, 2)


class FeedForward(nn.Module):
    """Two layers with a GELU (its tanh form) between them, four times as wide."""

    def __init__(self, width: int, dropout: float) -> None:
        super().__init__()
        self.expand = nn.Linear(width, 4 * width)
        self.contract = nn.Linear(4 * width, width)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor) -> Tensor:
        hidden = self.dropout(functional.gelu(self.expand(x), approximate="tanh"))
        return self.dropout(self.contract(hidden))


class DiTBlock(nn.Module):
    """One block of the diffusion transformer.

    Args:
        width: of the tokens, ``heads * head_dim``.
        context_dim: width of the context; None: it attends to its own tokens.
        dropout: behind the attention (twice, as the published models were trained) and in the MLP.
    """

    def __init__(
        self, width: int, heads: int, head_dim: int, context_dim: int | None, dropout: float
    ) -> None:
        super().__init__()
        self.modulate = nn.Linear(width, 2 * width)
        self.attention = Attention(width, context_dim or width, heads, head_dim)
        self.feed_forward = FeedForward(width, dropout)
        self.dropout = nn.Dropout(dropout)

    def forward(
        self,
        x: Tensor,
        time: Tensor | None,
        context: Tensor | None = None,
        mask: Tensor | None = None,
        cache: KVCache | None = None,
        modulation: Tensor | None = None,
    ) -> Tensor:
        """``x`` ``(B, T, W)`` at ``time`` ``(B, W)``, or ``(B, T, W)`` where tokens have times of
        their own; for the others see ``Attention``.

        ``modulation`` ``(2 * W,)``: scale and shift, instead of ``time``, where all samples share
        it.
        """
        if modulation is None:
            assert time is not None
            modulation = _for_tokens(self.modulation(time))
        scale, shift = modulation.chunk(2, dim=-1)
        normal = functional.layer_norm(x, x.shape[-1:], eps=1e-5) * (1 + scale) + shift
        attended = self.attention(normal, normal if context is None else context, mask, cache)
        x = x + self.dropout(self.dropout(attended))
        return x + self.feed_forward(functional.layer_norm(x, x.shape[-1:], eps=1e-5))

    def modulation(self, time: Tensor) -> Tensor:
        """``(..., W)`` -> scale and shift ``(..., 2 * W)``."""
        return self.modulate(functional.silu(time))


class ContextBlock(nn.Module):
    """One block of plain self-attention over the backbone's hidden states."""

    def __init__(self, heads: int, head_dim: int, dropout: float) -> None:
        super().__init__()
        width = heads * head_dim
        self.attention_norm = nn.LayerNorm(width, eps=1e-5)
        self.attention = Attention(width, width, heads, head_dim)
        self.feed_forward_norm = nn.LayerNorm(width, eps=1e-5)
        self.feed_forward = FeedForward(width, dropout)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor, mask: Tensor | None = None) -> Tensor:
        """``x`` ``(B, L, C)``, ``mask`` ``(B, L)`` bool: True where attended to; None: all."""
        normal = self.attention_norm(x)
        x = x + self.dropout(self.dropout(self.attention(normal, normal, mask)))
        return x + self.feed_forward(self.feed_forward_norm(x))


class TimeEncoder(nn.Module):
    """Time steps ``(...)`` int64 -> ``(..., W)``: 128 cosines, 128 sines and two layers."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(_SINES, width)
        self.out = nn.Linear(width, width)

    def forward(self, steps: Tensor) -> Tensor:
        half = _SINES // 2
        powers = torch.arange(half, device=steps.device, dtype=torch.float32) / (half - 1)
        angles = steps[..., None].float() * torch.exp(-math.log(_LONGEST) * powers)
        waves = torch.cat([angles.cos(), angles.sin()], dim=-1).to(self.hidden.weight.dtype)
        return self.out(functional.silu(self.hidden(waves)))


class DiT(nn.Module):
    """The diffusion transformer: tokens ``(B, T, W)`` -> ``(B, T, out_dim)``.

    Args:
        layers, heads, head_dim: its size; ``W`` is ``heads * head_dim``.
        context_dim: width of the context that the even blocks attend to.
        out_dim: width of the result.
        dropout: see ``DiTBlock``.
    """

    def __init__(
        self, layers: int, heads: int, head_dim: int, context_dim: int, out_dim: int, dropout: float
    ) -> None:
        super().__init__()
        width = heads * head_dim
        self.time = TimeEncoder(width)
        self.blocks = nn.ModuleList(
            DiTBlock(width, heads, head_dim, None if layer % 2 else context_dim, dropout)
            for layer in range(layers)
        )
        self.modulate = nn.Linear(width, 2 * width)
        self.out = nn.Linear(width, out_dim)

    def forward(
        self,
        x: Tensor,
        steps: Tensor,
        context: Tensor,
        masks: list[Tensor | None],
        cache: list[KVCache] | None = None,
    ) -> Tensor:
        """``x`` ``(B, T, W)`` at ``steps`` ``(B,)`` int64, or ``(B, T)``: one for each token.

        Args:
            context: ``(B, L, C)``.
            masks: for each even block ``(B, L)`` bool, where it attends to the context; None: all.
            cache: for each even block its KV cache of this same context.
        """
        time = self.time(steps)
        for layer, block in enumerate(self.blocks):
            if layer % 2:
                x = block(x, time)
            else:
                pair = layer // 2
                x = block(x, time, context, masks[pair], None if cache is None else cache[pair])
        return self._out(x, _for_tokens(self.modulate(functional.silu(time))))

    def step_tables(self, steps: Tensor) -> dict[str, Tensor]:
        """Tensors that depend only on the times ``steps`` ``(K,)`` of the integration steps.

        ``blocks`` ``(layers, K, 2 * W)``: scale and shift of each block; ``last`` ``(K, 2 * W)``.
        """
        time = self.time(steps)
        return {
            "blocks": torch.stack([block.modulation(time) for block in self.blocks]),
            "last": self.modulate(functional.silu(time)),
        }

    def step(
        self,
        x: Tensor,
        tables: Mapping[str, Tensor],
        number: int,
        cache: list[KVCache],
        masks: list[Tensor | None],
    ) -> Tensor:
        """As ``forward`` in integration step ``number`` of those that ``tables`` is for.

        Args:
            cache: for each even block its KV cache of the context.
            masks: for each even block ``(B, L)``, what is added to its scores; None: nothing.
        """
        for layer, block in enumerate(self.blocks):
            modulation = tables["blocks"][layer, number]
            if layer % 2:
                x = block(x, None, modulation=modulation)
            else:
                pair = layer // 2
                x = block(x, None, None, masks[pair], cache[pair], modulation)
        return self._out(x, tables["last"][number])

    def _out(self, x: Tensor, modulation: Tensor) -> Tensor:
        shift, scale = modulation.chunk(2, dim=-1)
        normal = functional.layer_norm(x, x.shape[-1:], eps=1e-6)
        return self.out(normal * (1 + scale) + shift)


def _for_tokens(modulation: Tensor) -> Tensor:
    """``(B, 2 * W)`` for all tokens of a sample, or ``(B, T, 2 * W)`` as it is."""
    return modulation[:, None] if modulation.ndim == 2 else modulation
