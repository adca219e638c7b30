"""Action chunks from a language model's hidden states, by queries that attend to them."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from fluxvla_core.errors import ConfigError
from fluxvla_models.transformer import Decoder
from fluxvla_models.widths import check_states


class LlavaActionHead(nn.Module):
    """One learned query an action attends to the hidden states and to the joint state.

    The loss is the mean absolute error. Heads of ``LlavaVLA`` have this one's methods; those that
    generate a chunk from noise get ``noise`` and ``time``, too.

    Args:
        horizon: actions in a chunk; action_dim, state_dim: of the (padded) action and state.
        context_dim: width of the hidden states; the model fills it in.
        width, num_heads, num_layers: of the decoder.
    """

    def __init__(
        self,
        horizon: int,
        action_dim: int,
        state_dim: int,
        context_dim: int | None = None,
        width: int = 512,
        num_heads: int = 8,
        num_layers: int = 2,
    ) -> None:
        super().__init__()
        if context_dim is None:
            raise ConfigError("LlavaActionHead needs context_dim, the hidden states' width")
        self.horizon, self.action_dim, self.state_dim = horizon, action_dim, state_dim
        self.queries = nn.Embedding(horizon, width)
        self.state_in = nn.Linear(state_dim, width)
        self.context_in = nn.Sequential(nn.LayerNorm(context_dim), nn.Linear(context_dim, width))
        self.decoder = Decoder(
            num_layers, width, num_heads, 4 * width, activation="gelu", pre_norm=True
        )
        self.action_out = nn.Linear(width, action_dim)

    def predict(self, hidden: Tensor, masks: Tensor, states: Tensor) -> Tensor:
        """``(B, L, C)``, ``(B, L)`` bool and ``(B, S)`` -> actions ``(B, T, D)``."""
        check_states("LlavaActionHead", "state_dim", states, self.state_dim)
        memory = torch.cat([self.state_in(states)[:, None], self.context_in(hidden)], dim=1)
        ignored = torch.cat([masks.new_zeros(len(masks), 1), ~masks], dim=1)
        queries = self.queries.weight[None].expand(len(hidden), -1, -1)
        found = self.decoder(
            torch.zeros_like(queries), memory, queries, torch.zeros_like(memory), ignored
        )
        return self.action_out(found)

    def errors(
        self,
        hidden: Tensor,
        masks: Tensor,
        states: Tensor,
        actions: Tensor,
        action_masks: Tensor,
        noise: Tensor | None = None,
        time: Tensor | None = None,
    ) -> Tensor:
        """Absolute errors ``(B, T, D)``, those beyond the end of an episode 0."""
        found = self.predict(hidden, masks, states)
        if found.shape != actions.shape:
            raise ConfigError(
                f"LlavaActionHead: actions are {tuple(actions.shape[1:])}, the head's are "
                f"{tuple(found.shape[1:])}",
                next="train_dataloader.dataset.action_window_size is the head's horizon, and "
                "action_dim the robot's",
            )
        return (found - actions).abs() * action_masks[..., None]

    def sample(
        self, hidden: Tensor, masks: Tensor, states: Tensor, noise: Tensor | None = None
    ) -> Tensor:
        """Actions ``(B, T, D)``."""
        return self.predict(hidden, masks, states)

    def fsdp_units(self) -> list[nn.Module]:
        """Blocks to shard one by one."""
        return list(self.decoder.layers)
