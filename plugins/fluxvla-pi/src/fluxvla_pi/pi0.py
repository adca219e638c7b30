"""PI0 (Black et al. 2024, arXiv 2410.24164): the state is a token, the time joins each action."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from fluxvla_models.widths import check_states
from torch import Tensor, nn
from torch.nn import functional

from fluxvla_pi.acting import Seen, times_of
from fluxvla_pi.flow_matching import PiFlowMatching, Suffix, time_features


class PI0FlowMatching(PiFlowMatching):
    """PI0: the state is a token, and the time joins every action.

    Args:
        max_state_dim: width of (padded) states.
        **kwargs: as ``PiFlowMatching`` takes them.
    """

    adaptive = False
    projections = (
        "action_in_proj",
        "action_out_proj",
        "action_time_mlp_in",
        "action_time_mlp_out",
        "state_proj",
    )
    input_sizes = replace(PiFlowMatching.input_sizes, states="max_state_dim")

    def __init__(self, max_state_dim: int = 32, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        width = self.llm_expert.size.width
        self.max_state_dim = max_state_dim
        self.state_proj = nn.Linear(max_state_dim, width)
        self.action_time_mlp_in = nn.Linear(2 * width, width)
        self.action_time_mlp_out = nn.Linear(width, width)

    def embed_suffix(self, states: Tensor, x: Tensor, tau: Tensor) -> Suffix:
        """The state, which sees what the prefix is, and actions, which see all."""
        actions = self.action_in_proj(x)
        times = time_features(tau, actions.shape[-1])
        if tau.ndim == 1:
            times = times[:, None]
        hidden = torch.cat([self.state_tokens(states), self._with_time(actions, times)], dim=1)
        blocks = torch.ones(hidden.shape[1], dtype=torch.long, device=x.device)
        blocks[0] = 0
        return Suffix(hidden, None, blocks)

    def step_tables(self) -> dict[str, Tensor]:
        """``times`` ``(K, W)``: what stands for the time in every step."""
        taus = times_of(self.num_steps, self.action_time_mlp_in.weight.device)
        return {"times": time_features(taus, self.llm_expert.size.width)}

    def tokens_at(self, x: Tensor, seen: Seen, tables: Mapping[str, Tensor], step: int) -> Tensor:
        """The state's token, and actions that know the time."""
        assert seen.state is not None
        actions = self._with_time(self.action_in_proj(x), tables["times"][step])
        return torch.cat([seen.state, actions], dim=1)

    def attended(self, device: torch.device) -> Tensor:
        """A row a token: the state does not attend to the actions."""
        places = torch.arange(self.n_action_steps + 1, device=device)
        return (places[:, None] > 0) | (places == 0)

    def state_tokens(self, states: Tensor) -> Tensor:
        """``(B, S)`` -> ``(B, 1, W)``."""
        check_states(type(self).__name__, "max_state_dim", states, self.max_state_dim)
        return self.state_proj(states)[:, None]

    def _with_time(self, actions: Tensor, times: Tensor) -> Tensor:
        """Actions ``(B, T, W)`` joined with ``times``, which are broadcast to them."""
        joined = torch.cat([actions, times.to(actions.dtype).expand_as(actions)], dim=-1)
        return self.action_time_mlp_out(functional.silu(self.action_time_mlp_in(joined)))
