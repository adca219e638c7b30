"""Actions as tokens: 256 bins over -1..1, the last 256 tokens of the vocabulary.

Source: Kim et al., "OpenVLA" (2024), section 3.2. The 256 edges are evenly spaced, so that there
are 255 intervals. A value below the second edge is bin 1, the value 1 itself bin 256, and bin ``i``
is token ``text_vocab_size - i``. Back from tokens, bins 255 and 256 are the same interval.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

BINS = 256


class ActionTokens(nn.Module):
    """Between normalised actions and token ids.

    Args:
        text_vocab_size: tokens of the tokenizer, without padding of the embedding.
    """

    def __init__(self, text_vocab_size: int) -> None:
        super().__init__()
        self.text_vocab_size = text_vocab_size
        edges = np.linspace(-1.0, 1.0, BINS)
        # numpy's numbers, wherever the model is made: torch's linspace rounds otherwise.
        self.register_buffer("edges", torch.from_numpy(edges), persistent=False)
        centers = torch.from_numpy((edges[:-1] + edges[1:]) / 2)
        self.register_buffer("centers", centers, persistent=False)

    @property
    def first(self) -> int:
        """The lowest token id of an action."""
        return self.text_vocab_size - BINS

    def encode(self, actions: Tensor) -> Tensor:
        """Normalised actions of any shape -> token ids int64; what is outside -1..1 is clipped."""
        clipped = actions.double().clamp(-1.0, 1.0)
        return self.text_vocab_size - torch.bucketize(clipped, self.edges.double(), right=True)

    def decode(self, tokens: Tensor) -> Tensor:
        """Token ids of any shape -> the centres of their bins, float32."""
        bins = (self.text_vocab_size - tokens - 1).clamp(0, BINS - 2)
        return self.centers.float()[bins]
