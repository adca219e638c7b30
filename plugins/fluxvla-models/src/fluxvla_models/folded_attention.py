"""Grouped-query attention without copies of keys and values.

Queries that share a key (Ainslie et al. 2023, arXiv 2305.13245) become rows of one head. The
numbers are the same; what is saved is a copy of keys and values for each query, in every layer of
every denoising step. It is for inference: what training computes stays as it is.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional


def folded_attention(query: Tensor, key: Tensor, value: Tensor, mask: Tensor) -> Tensor:
    """The answers ``(B, H, L, D)`` to ``query`` ``(B, H, L, D)``.

    Args:
        key, value: ``(B, G, M, D)``; query ``h`` asks key ``h // (H / G)``.
        mask: what :func:`folded_mask` gave for ``H / G`` groups.
    """
    groups = query.shape[1] // key.shape[1]
    rows = query.unflatten(1, (-1, groups)).flatten(2, 3)
    found = functional.scaled_dot_product_attention(rows, key, value, attn_mask=mask)
    return found.unflatten(2, (groups, -1)).flatten(1, 2)


def folded_mask(mask: Tensor, groups: int, dtype: torch.dtype) -> Tensor:
    """``mask`` as what is added to scores, for ``groups`` queries that share a key.

    A mask of bools would be turned into this one in every layer of every step.

    Args:
        mask: ``(B, 1, R, M)`` bool; R is 1 where it is the same for every query.
        dtype: of the scores.

    Returns:
        ``(B, 1, 1, M)`` for one row, else ``(B, 1, groups * R, M)``.
    """
    if mask.shape[2] > 1:
        mask = mask.repeat(1, 1, groups, 1)
    free = torch.zeros(mask.shape, dtype=dtype, device=mask.device)
    return free.masked_fill(~mask, float("-inf"))
