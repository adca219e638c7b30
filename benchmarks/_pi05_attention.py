"""Who sees what in ``_pi05_model.py``, and how fast kernels of attention stay in reach.

What comes first (images and prompt) sees itself and never the actions; actions see everything.
So there is no mask between them, only two calls, each over all of its keys. Then:

- All heads share one key and value head, so the heads of a token are simply more queries: ``H * L``
  rows with one head, which needs no copies of keys and no reordering in memory.
- Only the padding of prompts needs a mask, over keys. Without ``lang_masks`` there is none, and
  torch may take its flash kernel. With them :func:`first` gives a mask to a kernel that takes one;
  :func:`first_packed` gives none: every sample is two sequences for torch's flash kernel for
  sequences of different lengths, one of what counts and one of padding. Their bounds are computed
  on the device, shapes stay the same, and the host waits for nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F
from torch.nn.attention.varlen import varlen_attn


class Seen(NamedTuple):
    """Which of the keys ``(B, K)`` count: all, or the first few of each sample.

    ``mask``: ``(B, 1, 1, K)``; or ``queries`` and ``keys``: ``(2B + 1,)`` int32, where the two
    sequences of each sample begin, in rows of queries and in keys.
    """

    mask: Tensor | None = None
    queries: Tensor | None = None
    keys: Tensor | None = None


def first(counts: Tensor, keys: int) -> Seen:
    """The first ``counts`` ``(B,)`` of ``keys``, by a mask."""
    return Seen(mask=(torch.arange(keys, device=counts.device) < counts[:, None])[:, None, None])


def first_packed(counts: Tensor, keys: int, rows: int | Tensor, most_rows: int) -> Seen:
    """The same as sequences; ``rows`` of each sample's ``most_rows`` queries look at those keys."""

    def bounds(part: int | Tensor, whole: int) -> Tensor:
        begin = whole * torch.arange(len(counts) + 1, device=counts.device)
        middle = begin[:-1] + part
        both = torch.stack([begin[:-1], middle], 1).flatten()
        return torch.cat([both, begin[-1:]]).to(torch.int32)

    return Seen(queries=bounds(rows, most_rows), keys=bounds(counts, keys))


def attend(query: Tensor, key: Tensor, value: Tensor, seen: Seen) -> Tensor:
    """``(B, L, H, W)`` to ``(B, K, W)``, which all heads share -> ``(B, L, H * W)``."""
    batch, length, heads, width = query.shape
    rows = query.reshape(batch, length * heads, width)
    if seen.queries is None:
        found = F.scaled_dot_product_attention(
            rows[:, None], key[:, None], value[:, None], seen.mask
        )
    else:
        flat = (x.reshape(-1, 1, width) for x in (rows, key, value))
        longest = (length * heads, key.shape[1])
        found = varlen_attn(*flat, seen.queries, seen.keys, *longest)
    return found.reshape(batch, length, heads * width)


class Places(NamedTuple):
    """Cosines and sines ``(B, L, 1, W / 2)`` of rotary positions (Su et al. 2021)."""

    cosine: Tensor
    sine: Tensor

    @classmethod
    def of(cls, positions: Tensor, width: int, dtype: torch.dtype) -> Places:
        """Of ``(B, L)``."""
        half = width // 2
        rates = 10000.0 ** (-torch.arange(half, device=positions.device) / half)
        angles = positions[..., None, None] * rates
        return cls(angles.cos().to(dtype), angles.sin().to(dtype))

    def turn(self, x: Tensor) -> Tensor:
        """``(B, L, H, W)`` -> the same, contiguous."""
        a, b = x.chunk(2, -1)
        return torch.cat([a * self.cosine - b * self.sine, b * self.cosine + a * self.sine], -1)
