"""Gemma decoder layers (Gemma Team 2024, arXiv 2403.08295), two of which can share an attention.

In a mixture of transformers the expert's tokens attend to the vision-language model's and to their
own, and the model's tokens attend to their own only. So layer ``i`` of the model runs by itself,
and layer ``i`` of the expert gets its keys and values: the same numbers as one attention over both,
with no need to compute the first again for each denoising step.
"""

from __future__ import annotations

import torch
from fluxvla_models.folded_attention import folded_attention
from torch import Tensor, nn
from torch.nn import functional

from fluxvla_pi.sizes import GemmaSize

EPS = 1e-6
ROPE_BASE = 10000.0
LINEAR_LAYERS = r"(self_attn\.[qkvo]_proj|mlp\.(gate|up|down)_proj)"
"""Names of a layer's linear layers, a regular expression."""
Rope = tuple[Tensor, Tensor]
"""Cosines and sines, each ``(B, 1, L, head_dim)`` float32."""


class RMSNorm(nn.Module):
    """Root-mean-square normalisation in float32; a weight of 0 leaves the size at 1."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(width))

    def forward(
        self, x: Tensor, condition: Tensor | None = None, modulation: Tensor | None = None
    ) -> tuple[Tensor, Tensor | None]:
        """``x`` normalised, and no gate."""
        return (_unit(x) * (1.0 + self.weight.float())).to(x.dtype), None


class AdaRMSNorm(nn.Module):
    """Normalisation whose scale, shift and gate follow from a condition (adaRMS of PI0.5).

    As adaLN-zero (Peebles and Xie 2023, arXiv 2212.09748): all three are 0 at the beginning.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.dense = nn.Linear(width, 3 * width)
        nn.init.zeros_(self.dense.weight)
        nn.init.zeros_(self.dense.bias)

    def modulation(self, condition: Tensor) -> Tensor:
        """``(..., W)`` -> ``(..., 3 * W)`` float32: scale, shift and gate."""
        return self.dense(condition).float()

    def forward(
        self, x: Tensor, condition: Tensor | None = None, modulation: Tensor | None = None
    ) -> tuple[Tensor, Tensor | None]:
        """``x`` ``(B, L, W)`` normalised, and the gate.

        Args:
            condition: ``(B, W)`` or ``(B, L, W)``.
            modulation: ``(3 * W,)``, what :meth:`modulation` gave of a condition that all tokens
                share, instead of it.
        """
        if modulation is None:
            assert condition is not None
            modulation = self.modulation(condition)
            if condition.ndim == 2:
                modulation = modulation[:, None]
        scale, shift, gate = modulation.chunk(3, dim=-1)
        return (_unit(x) * (1.0 + scale) + shift).to(x.dtype), gate.to(x.dtype)


class GemmaAttention(nn.Module):
    """The projections of grouped-query attention, without biases."""

    def __init__(self, size: GemmaSize) -> None:
        super().__init__()
        self.q_proj = nn.Linear(size.width, size.heads * size.head_dim, bias=False)
        self.k_proj = nn.Linear(size.width, size.kv_heads * size.head_dim, bias=False)
        self.v_proj = nn.Linear(size.width, size.kv_heads * size.head_dim, bias=False)
        self.o_proj = nn.Linear(size.heads * size.head_dim, size.width, bias=False)


class GemmaMLP(nn.Module):
    """Gated linear unit with the tanh approximation of GELU."""

    def __init__(self, size: GemmaSize) -> None:
        super().__init__()
        self.gate_proj = nn.Linear(size.width, size.mlp_dim, bias=False)
        self.up_proj = nn.Linear(size.width, size.mlp_dim, bias=False)
        self.down_proj = nn.Linear(size.mlp_dim, size.width, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        gate = functional.gelu(self.gate_proj(x), approximate="tanh")
        return self.down_proj(gate * self.up_proj(x))


class GemmaLayer(nn.Module):
    """A decoder layer that gives its keys and values away, and takes others.

    Args:
        size: its sizes.
        adaptive: normalise by a condition.
        keys_only: nothing is made of what it answers but its keys and values (the last layer of
            the vision-language model): the rest is neither computed nor trained, and is there for
            checkpoints.
    """

    def __init__(self, size: GemmaSize, adaptive: bool = False, keys_only: bool = False) -> None:
        super().__init__()
        norm = AdaRMSNorm if adaptive else RMSNorm
        self.head_dim = size.head_dim
        self.groups = size.heads // size.kv_heads
        self.keys_only = keys_only
        self.input_layernorm = norm(size.width)
        self.self_attn = GemmaAttention(size)
        self.post_attention_layernorm = norm(size.width)
        self.mlp = GemmaMLP(size)
        if keys_only:
            unused = (self.self_attn.q_proj, self.self_attn.o_proj)
            for part in (*unused, self.post_attention_layernorm, self.mlp):
                part.requires_grad_(False)

    def forward(
        self,
        x: Tensor,
        rope: Rope,
        mask: Tensor,
        keys: Tensor | None = None,
        values: Tensor | None = None,
        condition: Tensor | None = None,
        modulations: tuple[Tensor, Tensor] | None = None,
        folded: bool = False,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The layer's answer ``(B, L, W)``, and its keys ``(B, kv_heads, L, D)`` and values.

        Values ``(B, L, kv_heads * D)`` are as their projection gives them, because outputs that are
        views make sharding warn.

        Args:
            x: ``(B, L, W)``.
            rope: of the positions of ``x``.
            mask: ``(B, 1, L or 1, M + L)`` bool: what is attended to, ``keys`` first.
            keys, values: another layer's, of M tokens.
            condition: ``(B, W)`` or ``(B, L, W)`` for adaptive normalisation.
            modulations: of both normalisations, instead of ``condition``: see ``AdaRMSNorm``.
            folded: without copies of keys and values; ``mask`` is then one of
                ``fluxvla_models.folded_attention``.
        """
        first, second = (None, None) if modulations is None else modulations
        normed, gate = self.input_layernorm(x, condition, first)
        attention = self.self_attn
        own_keys = rotate(self._heads(attention.k_proj(normed)), rope)
        own_values = attention.v_proj(normed)
        if self.keys_only:
            return x, own_keys, own_values
        query = rotate(self._heads(attention.q_proj(normed)), rope)
        every_key = own_keys if keys is None else torch.cat([keys, own_keys], dim=2)
        every_value = own_values if values is None else torch.cat([values, own_values], dim=1)
        heads = self._heads(every_value)
        if folded:
            attended = folded_attention(query, every_key, heads, mask)
        else:
            attended = functional.scaled_dot_product_attention(
                query,
                every_key.repeat_interleave(self.groups, dim=1),
                heads.repeat_interleave(self.groups, dim=1),
                attn_mask=mask,
            )
        x = _add(x, attention.o_proj(attended.transpose(1, 2).flatten(2)), gate)
        normed, gate = self.post_attention_layernorm(x, condition, second)
        return _add(x, self.mlp(normed), gate), own_keys, own_values

    def _heads(self, x: Tensor) -> Tensor:
        """``(B, L, heads * D)`` -> ``(B, heads, L, D)``."""
        return x.unflatten(-1, (-1, self.head_dim)).transpose(1, 2)


class GemmaDecoder(nn.Module):
    """Layers and a last normalisation; the model that uses them runs them one by one.

    Args:
        size: its sizes.
        vocab_size: words that it embeds; None for an expert, which has none.
        adaptive: normalise by a condition.
        keys_only: only the keys and values of its tokens are used: see ``GemmaLayer``.
    """

    def __init__(
        self,
        size: GemmaSize,
        vocab_size: int | None = None,
        adaptive: bool = False,
        keys_only: bool = False,
    ) -> None:
        super().__init__()
        self.size = size
        if vocab_size is not None:
            self.embed_tokens = nn.Embedding(vocab_size, size.width)
            nn.init.normal_(self.embed_tokens.weight, std=size.width**-0.5)
        self.layers = nn.ModuleList(
            GemmaLayer(size, adaptive, keys_only and i == size.depth - 1) for i in range(size.depth)
        )
        self.norm = AdaRMSNorm(size.width) if adaptive else RMSNorm(size.width)
        if keys_only:
            self.norm.requires_grad_(False)

    def embed(self, tokens: Tensor) -> Tensor:
        """Token ids ``(B, L)`` -> ``(B, L, width)``, scaled by the root of the width."""
        return self.embed_tokens(tokens) * self.size.width**0.5


def rope_of(positions: Tensor, head_dim: int) -> Rope:
    """Rotary position embedding (Su et al. 2021, arXiv 2104.09864) of ``positions`` ``(B, L)``."""
    steps = torch.arange(0, head_dim, 2, dtype=torch.float32, device=positions.device)
    frequencies = 1.0 / ROPE_BASE ** (steps / head_dim)
    angles = positions.float()[:, None, :, None] * frequencies
    angles = torch.cat([angles, angles], dim=-1)
    return angles.cos(), angles.sin()


def rotate(x: Tensor, rope: Rope) -> Tensor:
    """``x`` ``(B, heads, L, D)`` rotated, the first half of D paired with the second."""
    cos, sin = (part.to(x.dtype) for part in rope)
    first, second = x.chunk(2, dim=-1)
    return x * cos + torch.cat([-second, first], dim=-1) * sin


def _unit(x: Tensor) -> Tensor:
    x = x.float()
    return x * torch.rsqrt(x.square().mean(-1, keepdim=True) + EPS)


def _add(x: Tensor, update: Tensor, gate: Tensor | None) -> Tensor:
    return x + (update if gate is None else update * gate)
