"""Transformer layers of the language model and of the action expert that attends to it.

Both are Llama layers (Touvron et al. 2023): RMS norms, rotary positions, grouped keys and values,
a gated MLP. Rotary wavelengths reach 10 000, as in LeRobot, whatever the language model had.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from fluxvla_models.folded_attention import folded_attention
from torch import Tensor, nn
from torch.nn import functional

from fluxvla_smolvla.sizes import TextSize

LONGEST_WAVE = 10_000.0


@dataclass(frozen=True)
class Rotation:
    """Cosines and sines of rotary angles at some positions, each ``(B, 1, L, head_dim / 2)``."""

    cos: Tensor
    sin: Tensor

    @classmethod
    def at(cls, positions: Tensor, head_dim: int) -> Rotation:
        """Cosines and sines at ``positions`` ``(B, L)``, in fp32."""
        half = torch.arange(head_dim // 2, dtype=torch.float32, device=positions.device)
        angles = positions[:, None, :, None].float() / LONGEST_WAVE ** (2.0 / head_dim * half)
        return cls(angles.cos(), angles.sin())

    def rotate(self, x: Tensor) -> Tensor:
        """``(B, heads, L, head_dim)`` with its two halves rotated, computed in fp32."""
        first, second = x.float().chunk(2, dim=-1)
        turned = (
            first * self.cos - second * self.sin,
            second * self.cos + first * self.sin,
        )
        return torch.cat(turned, dim=-1).to(x.dtype)


class RMSNorm(nn.Module):
    """Root mean square normalisation, computed in fp32 whatever the dtype of input and weight."""

    def __init__(self, width: int, eps: float) -> None:
        super().__init__()
        self.eps = eps
        self.weight = nn.Parameter(torch.ones(width))

    def forward(self, x: Tensor) -> Tensor:
        wide = x.float()
        normed = wide * torch.rsqrt(wide.square().mean(-1, keepdim=True) + self.eps)
        return self.weight * normed.to(x.dtype)


class GatedMLP(nn.Module):
    """``down(silu(gate(x)) * up(x))``."""

    def __init__(self, size: TextSize) -> None:
        super().__init__()
        self.gate_proj = nn.Linear(size.hidden_size, size.intermediate_size, bias=False)
        self.up_proj = nn.Linear(size.hidden_size, size.intermediate_size, bias=False)
        self.down_proj = nn.Linear(size.intermediate_size, size.hidden_size, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        return self.down_proj(functional.silu(self.gate_proj(x)) * self.up_proj(x))


class Attention(nn.Module):
    """The projections of an attention, and the attention itself.

    Args:
        size: of the layer.
        key_width: width of what keys and values are made of; the layer's own if None.
    """

    def __init__(self, size: TextSize, key_width: int | None = None) -> None:
        super().__init__()
        self.head_dim, self.groups = size.head_dim, size.heads // size.kv_heads
        source = size.hidden_size if key_width is None else key_width
        queries, keys = size.heads * size.head_dim, size.kv_heads * size.head_dim
        self.q_proj = nn.Linear(size.hidden_size, queries, bias=False)
        self.k_proj = nn.Linear(source, keys, bias=False)
        self.v_proj = nn.Linear(source, keys, bias=False)
        self.o_proj = nn.Linear(queries, size.hidden_size, bias=False)

    def query(self, x: Tensor) -> Tensor:
        """``(B, L, width)`` -> ``(B, heads, L, head_dim)``."""
        return self._heads(self.q_proj(x))

    def key_value(self, key: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
        """Two ``(B, L, source)`` -> two ``(B, kv_heads, L, head_dim)``."""
        return self._heads(self.k_proj(key)), self._heads(self.v_proj(value))

    def attend(
        self, query: Tensor, key: Tensor, value: Tensor, mask: Tensor, folded: bool = False
    ) -> Tensor:
        """The attention's output ``(B, L, width)``.

        Args:
            query: ``(B, heads, L, head_dim)``.
            key, value: ``(B, kv_heads, S, head_dim)``.
            mask: bool, broadcast to ``(B, heads, L, S)``; True where a query sees a key.
            folded: ``mask`` is one of ``fluxvla_models.folded_attention``, which is used.
        """
        if folded:
            mixed = folded_attention(query, key, value, mask)
        else:
            key, value = (part.repeat_interleave(self.groups, 1) for part in (key, value))
            mixed = functional.scaled_dot_product_attention(query, key, value, attn_mask=mask)
        return self.o_proj(mixed.transpose(1, 2).flatten(2))

    def _heads(self, x: Tensor) -> Tensor:
        return x.unflatten(-1, (-1, self.head_dim)).transpose(1, 2)


class Layer(nn.Module):
    """Base class of both kinds of layers: norms, attention and MLP."""

    def __init__(self, size: TextSize, key_width: int | None = None) -> None:
        super().__init__()
        self.input_layernorm = RMSNorm(size.hidden_size, size.rms_norm_eps)
        self.self_attn = Attention(size, key_width)
        self.post_attention_layernorm = RMSNorm(size.hidden_size, size.rms_norm_eps)
        self.mlp = GatedMLP(size)

    def _after(self, x: Tensor, answer: Tensor) -> Tensor:
        x = x + answer
        return x + self.mlp(self.post_attention_layernorm(x))


@dataclass(frozen=True)
class Prefix:
    """Attention mask and rotary positions of the prefix: images, instruction and state.

    Args:
        mask: ``(B, 1, 1, C)`` bool, False on padding and absent cameras.
        context, state: rotations of the C context tokens and of the state token.
    """

    mask: Tensor
    context: Rotation
    state: Rotation


class ContextLayer(Layer):
    """A layer of the language model.

    Context tokens (images, instruction) attend to each other, the state token attends to them
    and to itself. Nothing attends to the state, so it goes beside the context: where the language
    model is frozen, only the state's share is differentiated.
    """

    def forward(
        self, context: Tensor, state: Tensor, prefix: Prefix, last: bool = False
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The next layer's context and state, and this one's keys and values.

        Args:
            context: ``(B, C, width)``; ``state``: ``(B, 1, width)``.
            prefix: positions and mask.
            last: no layer follows; the tokens are returned unchanged.

        Returns:
            ``(B, C, width)``, ``(B, 1, width)``, and keys and values, the state's behind the
            context's: ``(B, kv_heads, C + 1, head_dim)`` each.
        """
        attention = self.self_attn
        normed, state_normed = self.input_layernorm(context), self.input_layernorm(state)
        keys, values = attention.key_value(normed, normed)
        state_key, state_value = attention.key_value(state_normed, state_normed)
        keys = prefix.context.rotate(keys)
        all_keys = torch.cat([keys, prefix.state.rotate(state_key)], dim=2)
        all_values = torch.cat([values, state_value], dim=2)
        if last:
            return context, state, all_keys, all_values
        query = prefix.context.rotate(attention.query(normed))
        context = self._after(context, attention.attend(query, keys, values, prefix.mask))
        query = prefix.state.rotate(attention.query(state_normed))
        mask = functional.pad(prefix.mask, (0, 1), value=True)
        state = self._after(state, attention.attend(query, all_keys, all_values, mask))
        return context, state, all_keys, all_values


@dataclass(frozen=True)
class KVCache:
    """KV cache: the language model's keys and values of the prefix, which the expert attends to.

    Args:
        keys, values: of each layer, ``(B, kv_heads, S, head_dim)`` each.
        mask: ``(B, 1, 1, S)`` bool.
        length: ``(B,)``: real tokens, the position of the first action.
    """

    keys: tuple[Tensor, ...]
    values: tuple[Tensor, ...]
    mask: Tensor
    length: Tensor

    def repeat_interleave(self, times: int) -> KVCache:
        """Each sample ``times`` in a row (repeat-interleave)."""
        if times == 1:
            return self
        keys, values = (
            tuple(part.repeat_interleave(times, 0) for part in parts)
            for parts in (self.keys, self.values)
        )
        return KVCache(
            keys,
            values,
            self.mask.repeat_interleave(times, 0),
            self.length.repeat_interleave(times, 0),
        )


@dataclass(frozen=True)
class Suffix:
    """Mask and positions of the action tokens: ``causal`` ``(1, 1, T, T)`` bool, rotations of their
    positions behind the prefix and, for cross-attention, counted from 0 (``alone``)."""

    causal: Tensor
    behind: Rotation
    alone: Rotation


class ExpertLayer(Layer):
    """A layer of the action expert.

    One that ``crosses`` attends to the language model's keys and values, projected once more;
    another attends to them as they are and causally to the actions.
    """

    def __init__(self, size: TextSize, crosses: bool) -> None:
        super().__init__(size, size.kv_heads * size.head_dim if crosses else None)
        self.crosses = crosses

    def forward(
        self,
        x: Tensor,
        keys: Tensor,
        values: Tensor,
        mask: Tensor,
        suffix: Suffix,
        prepared: bool = False,
    ) -> Tensor:
        """``(B, T, width)`` -> the same shape.

        Args:
            keys, values, mask: one layer of ``KVCache``.
            suffix: mask and positions of the action tokens.
            prepared: keys and values are what :meth:`project` returned, and ``mask`` the whole
                mask of this kind of layer as ``fluxvla_models.folded_attention`` has it.
        """
        attention = self.self_attn
        normed = self.input_layernorm(x)
        query = attention.query(normed)
        if self.crosses:
            if not prepared:
                keys, values = self.project(keys, values)
            answer = attention.attend(suffix.alone.rotate(query), keys, values, mask, prepared)
            return self._after(x, answer)
        own_keys, own_values = attention.key_value(normed, normed)
        keys = torch.cat([keys, suffix.behind.rotate(own_keys)], dim=2)
        values = torch.cat([values, own_values], dim=2)
        if not prepared:
            rows = mask.expand(-1, -1, x.shape[1], -1)
            mask = torch.cat([rows, suffix.causal.expand(len(x), -1, -1, -1)], dim=3)
        answer = attention.attend(suffix.behind.rotate(query), keys, values, mask, prepared)
        return self._after(x, answer)

    def project(self, keys: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        """The language model's keys and values as this layer attends to them; the same in every
        denoising step."""
        if not self.crosses:
            return keys, values
        return self.self_attn.key_value(
            *(part.transpose(1, 2).flatten(2) for part in (keys, values))
        )
