"""What a backbone hands to the action head."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Context:
    """Features of pictures and words.

    Args:
        features: ``(B, L, C)``.
        mask: ``(B, L)`` bool, False on padding and on the places of absent pictures.
        pictures: ``(B, L)`` bool, True on the places of pictures.
    """

    features: Tensor
    mask: Tensor
    pictures: Tensor

    def repeated(self, times: int) -> Context:
        """Every row ``times`` times, one after the other."""
        return Context(
            self.features.repeat_interleave(times, 0),
            self.mask.repeat_interleave(times, 0),
            self.pictures.repeat_interleave(times, 0),
        )
