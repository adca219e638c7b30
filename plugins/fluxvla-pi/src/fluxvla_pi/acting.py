"""Acting of PI0 and PI0.5 in two parts: what the denoising steps share, and the steps.

The times of the steps are known beforehand, so what follows from them and the weights (sinusoids,
and in PI0.5 the scale, shift and gate of every normalisation of the expert) is computed for all
steps together. Rotary tables, the mask and the language model's keys and values are the same in
every step of an observation. The steps themselves only launch operations on tensors.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from fluxvla_models.folded_attention import folded_mask
from torch import Tensor

from fluxvla_pi.gemma import GemmaDecoder, Rope

Tables = Mapping[str, Tensor]


@dataclass(frozen=True)
class Seen:
    """What every step needs of an observation of P tokens, S being the expert's tokens.

    Args:
        keys: ``(B, kv_heads, P, D)`` of each layer; values: ``(B, P, kv_heads * D)``.
        rope: of the expert's tokens.
        mask: ``(B, 1, 1 or groups * S, P + S)``, what is added to the scores.
        state: ``(B, 1, W)``, PI0's state token; None in PI0.5.
    """

    keys: list[Tensor]
    values: list[Tensor]
    rope: Rope
    mask: Tensor
    state: Tensor | None = None

    def to_tensors(self) -> dict[str, Tensor]:
        """By name, as ``VLA.observe`` gives it."""
        found = {"cos": self.rope[0], "sin": self.rope[1], "mask": self.mask}
        if self.state is not None:
            found["state"] = self.state
        for name, parts in (("key", self.keys), ("value", self.values)):
            found |= {f"{name}.{layer}": part for layer, part in enumerate(parts)}
        return found

    @classmethod
    def of(cls, tensors: Tables, layers: int) -> Seen:
        """The inverse of :meth:`to_tensors`."""
        keys, values = (
            [tensors[f"{name}.{layer}"] for layer in range(layers)] for name in ("key", "value")
        )
        rope = (tensors["cos"], tensors["sin"])
        return cls(keys, values, rope, tensors["mask"], tensors.get("state"))


def seen_of(
    known: list[tuple[Tensor, Tensor]],
    real: Tensor,
    own: Tensor,
    rope: Rope,
    groups: int,
    state: Tensor | None,
) -> Seen:
    """Put together what the steps need.

    Args:
        known: keys and values of every layer of the language model.
        real: ``(B, P)`` bool, False on padding.
        own: ``(R, S)`` bool, which of the expert's tokens each of them attends to; one row if they
            all attend to the same.
        rope: of the expert's tokens, float32.
        groups: queries that share a key.
        state: see :class:`Seen`.
    """
    dtype = known[0][1].dtype
    batch, rows = len(real), len(own)
    ahead = real[:, None, None].expand(-1, 1, rows, -1)
    mask = torch.cat([ahead, own.expand(batch, 1, *own.shape)], dim=-1)
    turned = (rope[0].to(dtype), rope[1].to(dtype))
    keys, values = ([part[place] for part in known] for place in (0, 1))
    return Seen(keys, values, turned, folded_mask(mask, groups, dtype), state)


def times_of(steps: int, device: torch.device) -> Tensor:
    """``(K,)`` float32: the time ``tau`` of each step, from 1 (noise) downwards."""
    return torch.tensor([1.0 - step / steps for step in range(steps)]).to(device)


def modulations_of(expert: GemmaDecoder, condition: Tensor) -> Tensor:
    """``condition`` ``(K, W)`` of the K steps -> ``(2 * depth + 1, K, 3 * W)`` float32.

    Of both normalisations of every layer, and of the last one.
    """
    norms = [
        norm
        for layer in expert.layers
        for norm in (layer.input_layernorm, layer.post_attention_layernorm)
    ]
    return torch.stack([norm.modulation(condition) for norm in (*norms, expert.norm)])


def expert_step(
    expert: GemmaDecoder, hidden: Tensor, seen: Seen, tables: Tables, step: int
) -> Tensor:
    """The expert's tokens ``(B, S, W)`` of one step, normalised after its last layer."""
    by_norm = tables.get("modulations")
    for number, layer in enumerate(expert.layers):
        pair = None
        if by_norm is not None:
            pair = by_norm[2 * number, step], by_norm[2 * number + 1, step]
        keys, values = seen.keys[number], seen.values[number]
        hidden, _, _ = layer(
            hidden, seen.rope, seen.mask, keys, values, modulations=pair, folded=True
        )
    last = None if by_norm is None else by_norm[-1, step]
    normed, _ = expert.norm(hidden, modulation=last)
    return normed
