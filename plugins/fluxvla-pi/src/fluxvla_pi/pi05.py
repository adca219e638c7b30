"""PI0.5 (Physical Intelligence 2025, arXiv 2504.16054): the state stands in the prompt, the time
conditions every normalisation of the expert."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from fluxvla_pi.acting import Seen, modulations_of, times_of
from fluxvla_pi.flow_matching import PiFlowMatching, Suffix, time_features


class PI05FlowMatching(PiFlowMatching):
    """PI0.5, whose ``states`` are words of the prompt.

    Args:
        **kwargs: as ``PiFlowMatching`` takes them.
    """

    adaptive = True
    projections = ("action_in_proj", "action_out_proj", "time_mlp_in", "time_mlp_out")

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        width = self.llm_expert.size.width
        self.time_mlp_in = nn.Linear(width, width)
        self.time_mlp_out = nn.Linear(width, width)

    def embed_suffix(self, states: Tensor, x: Tensor, tau: Tensor) -> Suffix:
        """Actions, all of which see all; the time is the condition."""
        hidden = self.action_in_proj(x)
        blocks = torch.zeros(hidden.shape[1], dtype=torch.long, device=x.device)
        return Suffix(hidden, self._condition(tau, hidden.dtype), blocks)

    def step_tables(self) -> dict[str, Tensor]:
        """``modulations`` ``(2 * depth + 1, K, 3 * W)``: of every normalisation in every step."""
        weight = self.time_mlp_in.weight
        condition = self._condition(times_of(self.num_steps, weight.device), weight.dtype)
        return {"modulations": modulations_of(self.llm_expert, condition)}

    def tokens_at(self, x: Tensor, seen: Seen, tables: Mapping[str, Tensor], step: int) -> Tensor:
        """The actions; the time comes in with the normalisations."""
        return self.action_in_proj(x)

    def attended(self, device: torch.device) -> Tensor:
        """One row: every action attends to every other."""
        return torch.ones(1, self.n_action_steps, dtype=torch.bool, device=device)

    def _condition(self, tau: Tensor, dtype: torch.dtype) -> Tensor:
        """``(..., W)`` for times ``tau`` ``(...)``."""
        times = time_features(tau, self.llm_expert.size.width).to(dtype)
        return functional.silu(self.time_mlp_out(functional.silu(self.time_mlp_in(times))))
