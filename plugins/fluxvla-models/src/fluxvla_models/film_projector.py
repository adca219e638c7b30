"""FiLM projector: image features modulated by the instruction, joined with the robot state."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from fluxvla_models.widths import check_states


class FiLMProjector(nn.Module):
    """Visual features scaled and shifted by the instruction, joined with state and instruction.

    The scaling is FiLM (Perez et al. 2018): the instruction chooses what in the image counts.

    Args:
        vision_dim, text_dim, state_dim: widths of what comes in; the model fills them in.
        width: length of the context vector.
    """

    def __init__(
        self,
        vision_dim: int | None = None,
        text_dim: int | None = None,
        state_dim: int | None = None,
        width: int = 256,
    ) -> None:
        super().__init__()
        if vision_dim is None or text_dim is None or state_dim is None:
            raise ValueError("FiLMProjector needs vision_dim, text_dim and state_dim")
        self.out_dim, self.state_dim = width, state_dim
        self.vision = nn.Sequential(nn.LayerNorm(vision_dim), nn.Linear(vision_dim, width))
        self.state = nn.Sequential(nn.Linear(state_dim, width), nn.GELU(), nn.Linear(width, width))
        self.text = nn.Linear(text_dim, width)
        self.film = nn.Linear(text_dim, 2 * width)
        self.mix = nn.Sequential(
            nn.LayerNorm(3 * width),
            nn.Linear(3 * width, 2 * width),
            nn.GELU(),
            nn.Linear(2 * width, width),
        )

    def forward(self, vision: Tensor, text: Tensor, states: Tensor) -> Tensor:
        """``(B, vision_dim)``, ``(B, text_dim)``, ``(B, state_dim)`` -> ``(B, width)``."""
        check_states("FiLMProjector", "state_dim", states, self.state_dim)
        scale, shift = self.film(text).chunk(2, dim=-1)
        seen = self.vision(vision) * (1 + scale) + shift
        return self.mix(torch.cat([seen, self.state(states), self.text(text)], dim=-1))
