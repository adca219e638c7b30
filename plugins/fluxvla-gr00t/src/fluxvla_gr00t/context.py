"""``Context``: the hidden states that a backbone hands to the action head."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Context:
    """Hidden states of image and text tokens.

    Args:
        features: ``(B, L, C)``.
        mask: ``(B, L)`` bool, False on padding and on the tokens of absent images.
        image_mask: ``(B, L)`` bool, True on image tokens.
    """

    features: Tensor
    mask: Tensor
    image_mask: Tensor

    def repeat_interleave(self, repeats: int) -> Context:
        """Each sample ``repeats`` times in a row."""
        return Context(
            self.features.repeat_interleave(repeats, 0),
            self.mask.repeat_interleave(repeats, 0),
            self.image_mask.repeat_interleave(repeats, 0),
        )
