"""PaliGemma (Beyer et al. 2024, arXiv 2407.07726): images and words as one row of tokens."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from fluxvla_pi.gemma import GemmaDecoder
from fluxvla_pi.siglip import SiglipVisionTower


@dataclass(frozen=True)
class Prefix:
    """What is seen and asked, as the model's layers take it.

    Args:
        hidden: ``(B, P, W)`` embedded tokens.
        real: ``(B, P)`` bool, False on padding.
    """

    hidden: Tensor
    real: Tensor

    @property
    def rope_positions(self) -> Tensor:
        """``(B, P)``: :func:`rope_positions` of its tokens."""
        return rope_positions(self.real)

    @property
    def mask(self) -> Tensor:
        """``(B, 1, 1, P)``: every token attends to every real one.

        Padding does so, too: nobody attends to it, and a row without any key has no softmax.
        """
        return self.real[:, None, None]


def rope_positions(real: Tensor) -> Tensor:
    """``(B, L)`` int64 of tokens that are ``real`` ``(B, L)``, or padding, which takes no place."""
    return real.long().cumsum(1) - 1


def embed_prefix(
    vision: SiglipVisionTower,
    projector: nn.Linear,
    language: GemmaDecoder,
    images: Tensor,
    img_masks: Tensor | None,
    lang_tokens: Tensor,
    lang_masks: Tensor,
) -> Prefix:
    """Images and words as tokens, images first.

    Args:
        images: ``(B, 3N, H, W)`` in -1..1.
        img_masks: ``(B, N)``, False for a camera that is not there; None if all are.
        lang_tokens, lang_masks: ``(B, L)`` int64 and bool.
    """
    batch, cameras = len(images), images.shape[1] // 3
    seen = vision(images.reshape(batch * cameras, 3, *images.shape[2:]))
    seen = projector(seen).unflatten(0, (batch, cameras)).flatten(1, 2)
    words = language.embed(lang_tokens)
    if img_masks is None:
        img_masks = torch.ones(batch, cameras, dtype=torch.bool, device=images.device)
    patches = vision.size.patches
    real = torch.cat([img_masks.bool().repeat_interleave(patches, 1), lang_masks.bool()], dim=1)
    return Prefix(torch.cat([seen, words.to(seen.dtype)], dim=1), real)
