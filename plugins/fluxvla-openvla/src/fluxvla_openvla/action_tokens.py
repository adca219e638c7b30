"""Actions as tokens: 256 bins over -1..1, the last 256 tokens of the vocabulary.

Source: Kim et al., "OpenVLA" (2024), section 3.2. The 256 edges are evenly spaced, so that there
are 255 intervals. A value below the second edge is bin 1, the value 1 itself bin 256, and bin ``i``
is token ``text_vocab_size - i``. Back from tokens, bins 255 and 256 are the same interval.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

BINS = 256
_EDGES = np.linspace(-1.0, 1.0, BINS)
_CENTERS = (_EDGES[:-1] + _EDGES[1:]) / 2


class ActionTokens:
    """Between normalised actions and token ids.

    The edges are no buffers of the model: one that is cast to bfloat16 would round them.

    Args:
        text_vocab_size: tokens of the tokenizer, without padding of the embedding.
    """

    def __init__(self, text_vocab_size: int) -> None:
        self.text_vocab_size = text_vocab_size

    @property
    def first(self) -> int:
        """The lowest token id of an action."""
        return self.text_vocab_size - BINS

    def encode(self, actions: Tensor) -> Tensor:
        """Normalised actions of any shape -> token ids int64; what is outside -1..1 is clipped."""
        edges = torch.from_numpy(_EDGES).to(actions.device)
        clipped = actions.double().clamp(-1.0, 1.0)
        return self.text_vocab_size - torch.bucketize(clipped, edges, right=True)

    def decode(self, tokens: Tensor) -> Tensor:
        """Token ids of any shape -> the centres of their bins, float32."""
        bins = (self.text_vocab_size - tokens - 1).clamp(0, BINS - 2)
        return torch.from_numpy(_CENTERS).to(tokens.device, torch.float32)[bins]
