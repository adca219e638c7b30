"""The action expert: a transformer that turns noisy actions into the velocity of flow matching."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from fluxvla_models.folded_attention import folded_mask
from fluxvla_models.velocity import sinusoids
from torch import Tensor, nn
from torch.nn import functional

from fluxvla_core.errors import ConfigError
from fluxvla_smolvla.sizes import TextSize
from fluxvla_smolvla.transformer import ExpertLayer, KVCache, RMSNorm, Rotation, Suffix


class Expert(nn.Module):
    """Layers that attend to every ``stride``-th layer of the language model.

    Args:
        size: of the expert.
        stride: layers of the language model for one of the expert's.
        self_attn_every_n_layers: layers of the language model whose number is a multiple of this
            are joined with self-attention between actions, the others crossed; 0 crosses all.

    Raises:
        ConfigError: counted in the expert's layers, other layers would be crossed, and the
            published names do not say which.
    """

    def __init__(self, size: TextSize, stride: int, self_attn_every_n_layers: int) -> None:
        super().__init__()
        every = self_attn_every_n_layers
        crossed = [_crosses(i, every) for i in range(size.layers)]
        if crossed != [_crosses(i * stride, every) for i in range(size.layers)]:
            raise ConfigError(
                f"SmolVLA: self_attn_every_n_layers {every} and {stride} layers of the language "
                "model for one of the expert's do not go together",
                next="make num_expert_layers that of the language model's layers",
            )
        self.head_dim, self.stride = size.head_dim, stride
        self.layers = nn.ModuleList(ExpertLayer(size, crosses) for crosses in crossed)
        self.norm = RMSNorm(size.hidden_size, size.rms_norm_eps)

    def forward(self, x: Tensor, cache: KVCache) -> Tensor:
        """Action tokens ``(B, T, width)`` -> the same shape."""
        suffix = self._suffix(cache, x.shape[1])
        for number, layer in enumerate(self.layers):
            place = number * self.stride
            x = layer(x, cache.keys[place], cache.values[place], cache.mask, suffix)
        return self.norm(x)

    def observe(self, cache: KVCache, count: int) -> dict[str, Tensor]:
        """What does not depend on the ``count`` action tokens, for :meth:`step`: keys and values of
        every layer, masks and rotations."""
        suffix = self._suffix(cache, count)
        groups, dtype = self.layers[0].self_attn.groups, cache.values[0].dtype
        rows = cache.mask.expand(-1, -1, count, -1)
        whole = torch.cat([rows, suffix.causal.expand(len(rows), -1, -1, -1)], dim=3)
        found = {
            "crossed": folded_mask(cache.mask, groups, dtype),
            "joined": folded_mask(whole, groups, dtype),
            "behind.cos": suffix.behind.cos,
            "behind.sin": suffix.behind.sin,
            "alone.cos": suffix.alone.cos,
            "alone.sin": suffix.alone.sin,
        }
        for number, layer in enumerate(self.layers):
            place = number * self.stride
            keys, values = layer.project(cache.keys[place], cache.values[place])
            found |= {f"key.{number}": keys, f"value.{number}": values}
        return found

    def step(self, x: Tensor, seen: Mapping[str, Tensor]) -> Tensor:
        """As ``forward``, with the tensors of :meth:`observe`."""
        behind, alone = (
            Rotation(seen[f"{name}.cos"], seen[f"{name}.sin"]) for name in ("behind", "alone")
        )
        suffix = Suffix(seen["joined"], behind, alone)
        for number, layer in enumerate(self.layers):
            mask = seen["crossed" if layer.crosses else "joined"]
            keys, values = seen[f"key.{number}"], seen[f"value.{number}"]
            x = layer(x, keys, values, mask, suffix, prepared=True)
        return self.norm(x)

    def _suffix(self, cache: KVCache, count: int) -> Suffix:
        device = cache.length.device
        places = torch.arange(count, device=device)[None]
        return Suffix(
            causal=torch.ones(count, count, dtype=torch.bool, device=device).tril()[None, None],
            behind=Rotation.at(cache.length[:, None] + places, self.head_dim),
            alone=Rotation.at(places, self.head_dim),
        )


class ActionTimeMLP(nn.Module):
    """Noisy actions ``(B, T, D)`` and their time, ``(B,)`` or each its own ``(B, T)`` -> action
    tokens ``(B, T, width)``."""

    def __init__(self, action_dim: int, width: int, shortest: float, longest: float) -> None:
        super().__init__()
        if not 0 < shortest < longest:
            raise ConfigError(
                f"SmolVLA: min_period {shortest} and max_period {longest} must be positive, the "
                "second one larger"
            )
        self.shortest, self.longest = shortest, longest
        self.action_in_proj = nn.Linear(action_dim, width)
        self.action_time_mlp_in = nn.Linear(2 * width, width)
        self.action_time_mlp_out = nn.Linear(width, width)

    def forward(self, noisy: Tensor, time: Tensor) -> Tensor:
        features = self.time_features(time.flatten()).unflatten(0, time.shape)
        return self.embed_at_time(noisy, features if time.ndim == 2 else features[:, None])

    def time_features(self, time: Tensor) -> Tensor:
        """Sinusoidal features ``(B, width)`` float64 of times ``(B,)``."""
        width = self.action_in_proj.out_features
        return sinusoids(time, width, self.shortest, self.longest)

    def embed_at_time(self, noisy: Tensor, time_features: Tensor) -> Tensor:
        """Action tokens of ``noisy`` actions, ``time_features`` being broadcast to them."""
        actions = self.action_in_proj(noisy)
        joined = torch.cat([actions, time_features.to(actions.dtype).expand_as(actions)], dim=2)
        return self.action_time_mlp_out(functional.silu(self.action_time_mlp_in(joined)))


def _crosses(layer: int, every: int) -> bool:
    return every < 1 or layer % every != 0
