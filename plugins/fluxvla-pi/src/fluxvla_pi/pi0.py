"""PI0 (Black et al. 2024, arXiv 2410.24164): the state is a token, the time joins each action."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from fluxvla_models.widths import check_states
from torch import Tensor, nn
from torch.nn import functional

from fluxvla_pi.acting import Seen, times_of
from fluxvla_pi.flow_matching import PiFlowMatching, Suffix, time_features


class PI0FlowMatching(PiFlowMatching):
    """PI0; arguments as of ``PiFlowMatching``, and ``max_state_dim``, the width of states."""

    adaptive = False

    def __init__(
        self,
        variant: str | Mapping[str, int] = "gemma_2b",
        expert_variant: str | Mapping[str, int] = "gemma_300m",
        vision_variant: str | Mapping[str, int] = "so400m",
        n_action_steps: int = 50,
        max_action_dim: int = 32,
        max_state_dim: int = 32,
        ori_action_dim: int | None = None,
        num_steps: int = 10,
        prefix_conditioning: bool = False,
        vocab_size: int = 257152,
        freeze_vision_backbone: bool = False,
        freeze_llm_backbone: bool = False,
        pretrained_name_or_path: str | None = None,
    ) -> None:
        super().__init__(
            variant=variant,
            expert_variant=expert_variant,
            vision_variant=vision_variant,
            n_action_steps=n_action_steps,
            max_action_dim=max_action_dim,
            ori_action_dim=ori_action_dim,
            num_steps=num_steps,
            prefix_conditioning=prefix_conditioning,
            vocab_size=vocab_size,
            freeze_vision_backbone=freeze_vision_backbone,
            freeze_llm_backbone=freeze_llm_backbone,
            pretrained_name_or_path=pretrained_name_or_path,
        )
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
        hidden = torch.cat([self.state_tokens(states), self._told(actions, times)], dim=1)
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
        actions = self._told(self.action_in_proj(x), tables["times"][step])
        return torch.cat([seen.state, actions], dim=1)

    def attended(self, device: torch.device) -> Tensor:
        """A row a token: the state does not attend to the actions."""
        places = torch.arange(self.n_action_steps + 1, device=device)
        return (places[:, None] > 0) | (places == 0)

    def state_tokens(self, states: Tensor) -> Tensor:
        """``(B, S)`` -> ``(B, 1, W)``."""
        check_states(type(self).__name__, "max_state_dim", states, self.max_state_dim)
        return self.state_proj(states)[:, None]

    def _told(self, actions: Tensor, times: Tensor) -> Tensor:
        """``(B, T, W)`` told the time, ``times`` being broadcast to them."""
        joined = torch.cat([actions, times.to(actions.dtype).expand_as(actions)], dim=-1)
        return self.action_time_mlp_out(functional.silu(self.action_time_mlp_in(joined)))
