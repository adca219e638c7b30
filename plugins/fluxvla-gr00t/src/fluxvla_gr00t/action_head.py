"""GR00T's action head: flow matching by a diffusion transformer, for N1.5 and N1.7.

The path is ``x_t = (1 - t) * noise + t * actions``; the network answers with the velocity
``actions - noise``. Its time steps count thousandths. Bjorck et al. 2025, "GR00T N1: An Open
Foundation Model for Generalist Humanoid Robots" (arXiv 2503.14734).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import torch
from fluxvla_models.guidance import Guide
from fluxvla_models.widths import check_actions, check_states
from torch import Tensor, nn

from fluxvla_core.errors import ConfigError
from fluxvla_gr00t.context import Context
from fluxvla_gr00t.embodiments import ActionEncoder, EmbodimentMLP
from fluxvla_gr00t.transformer import ContextBlock, DiT, KVCache

_BUCKETS = 1000
_CHOSEN = {"action_encoder": ("actions", "joined", "out"), "action_decoder": ("hidden", "out")}
"""Parts with weights for each embodiment that every step needs."""


class GR00TActionHead(nn.Module):
    """Context and state to action chunk; the defaults are those of GR00T N1.5.

    Everything random comes in with the batch, but for ``dropout`` and ``state_dropout``, which
    act in training alone; 0 turns them off.

    Args:
        horizon: actions in a chunk; 16 in N1.5, 40 in N1.7.
        action_dim, state_dim: widths that actions and states are padded to; 132 each in N1.7.
        context_dim: width of the backbone's features; the model fills it in.
        ori_action_dim: the robot's own width; the loss is the mean over these dimensions alone.
            None: over all.
        embodiments: kinds of robots with layers of their own.
        layers: blocks of the diffusion transformer, an even number; 32 in N1.7.
        heads, head_dim: its attention; the tokens are ``heads * head_dim`` wide.
        hidden_dim: width inside the encoder of states and the decoder of actions.
        context_layers, context_heads: of the transformer over the context.
        future_tokens: learned tokens between state and actions; 0 in N1.7.
        attend_text_every: of the blocks that attend to the context, every so-many-th attends to the
            text, beginning with the first, the others to the images; 2 in N1.7. None: all to all.
        max_steps: longest chunk that there are positions for.
        num_steps: Euler steps from noise to actions.
        dropout: 0.2, as published.
        state_dropout: probability of training on a sample without its state; 0.2 in N1.7.
        attend_padding: let attention see padding (but not where ``attend_text_every`` masks it),
            as the published training code does. A sample's result then depends on how long the
            longest of its batch is. False: it is what that code gives for the sample alone.
        mean_over_valid: divide the loss by the number of unmasked actions of the batch, as the
            published training code does. A sample's weight then depends on the others of its
            batch, so that several processes train another loss than one. False: by all actions.
    """

    def __init__(
        self,
        horizon: int = 16,
        action_dim: int = 32,
        state_dim: int = 64,
        context_dim: int | None = None,
        ori_action_dim: int | None = None,
        embodiments: int = 32,
        layers: int = 16,
        heads: int = 32,
        head_dim: int = 48,
        hidden_dim: int = 1024,
        context_layers: int = 4,
        context_heads: int = 32,
        future_tokens: int = 32,
        attend_text_every: int | None = None,
        max_steps: int = 1024,
        num_steps: int = 4,
        dropout: float = 0.2,
        state_dropout: float = 0.0,
        attend_padding: bool = False,
        mean_over_valid: bool = False,
    ) -> None:
        super().__init__()
        _check(
            horizon=(horizon, 1, max_steps),
            ori_action_dim=(
                action_dim if ori_action_dim is None else ori_action_dim,
                1,
                action_dim,
            ),
            num_steps=(num_steps, 1, _BUCKETS),
            embodiments=(embodiments, 1, None),
            attend_text_every=(2 if attend_text_every is None else attend_text_every, 2, None),
        )
        if context_dim is None or context_dim % context_heads:
            raise ConfigError(
                f"GR00TActionHead: context_dim {context_dim} is not a multiple of context_heads "
                f"{context_heads}",
                cause="the model fills in the width of its backbone's features",
            )
        if layers % 2:
            raise ConfigError(
                f"GR00TActionHead: layers {layers} is odd",
                cause="blocks that see the context and blocks that do not stand in pairs",
            )
        width = heads * head_dim
        self.horizon, self.action_dim, self.state_dim = horizon, action_dim, state_dim
        self.loss_dim = action_dim if ori_action_dim is None else ori_action_dim
        self.embodiments = embodiments
        self.attend_text_every, self.attend_padding = attend_text_every, attend_padding
        self.num_steps, self.state_dropout = num_steps, state_dropout
        self.mean_over_valid = mean_over_valid
        self.context_norm = nn.LayerNorm(context_dim)
        self.context_blocks = nn.ModuleList(
            ContextBlock(context_heads, context_dim // context_heads, dropout)
            for _ in range(context_layers)
        )
        self.state_encoder = EmbodimentMLP(embodiments, state_dim, hidden_dim, width)
        self.action_encoder = ActionEncoder(embodiments, action_dim, width)
        self.positions = nn.Embedding(max_steps, width)
        self.future_tokens = nn.Embedding(future_tokens, width) if future_tokens else None
        self.dit = DiT(layers, heads, head_dim, context_dim, hidden_dim, dropout)
        self.action_decoder = EmbodimentMLP(embodiments, hidden_dim, hidden_dim, action_dim)
        for table in (self.positions, self.future_tokens):
            if table is not None:
                nn.init.normal_(table.weight, std=0.02)

    def encode_context(self, context: Context) -> Context:
        """The context with the features that the diffusion transformer attends to."""
        features = self.context_norm(context.features)
        mask = None if self.attend_padding else context.mask
        for block in self.context_blocks:
            features = block(features, mask)
        return Context(features, context.mask, context.image_mask)

    def encode_states(self, states: Tensor, ids: Tensor) -> Tensor:
        """``(B, S)`` and ``ids`` ``(B,)`` -> tokens ``(B, 1, W)``."""
        check_states("GR00TActionHead", "state_dim", states, self.state_dim)
        tokens = self.state_encoder(states[:, None], ids)
        if self.training and self.state_dropout > 0:
            keep = torch.rand(len(tokens), 1, 1, device=tokens.device) >= self.state_dropout
            tokens = tokens * keep.to(tokens.dtype)
        return tokens

    def velocity(
        self,
        x: Tensor,
        steps: Tensor,
        context: Context,
        state: Tensor,
        ids: Tensor,
        cache: list[KVCache] | None = None,
        given: Tensor | None = None,
    ) -> Tensor:
        """The velocity ``(B, T, D)`` at ``x`` ``(B, T, D)``.

        Args:
            steps: ``(B,)`` int64, the time in thousandths.
            context: of ``encode_context``; state: of ``encode_states``; ids: ``(B,)`` int64.
            cache: the blocks' KV caches of the context, shared by all steps.
            given: ``(B, T)`` bool, the actions of ``x`` that are known: theirs is the time of data.
        """
        each = steps if given is None else torch.where(given, _BUCKETS, steps[:, None])
        actions = self.action_encoder(x, each, ids)
        actions = actions + self.positions.weight[: x.shape[1]].to(actions.dtype)
        tokens = [state, actions]
        if self.future_tokens is not None:
            future = self.future_tokens.weight.to(actions.dtype)
            tokens.insert(1, future.expand(len(x), -1, -1))
        joined = torch.cat(tokens, dim=1)
        if given is not None:
            before = steps[:, None].expand(-1, joined.shape[1] - x.shape[1])
            each = torch.cat([before, each], dim=1)
        hidden = self.dit(joined, each, context.features, self._masks(context), cache)
        return self.action_decoder(hidden[:, -x.shape[1] :], ids)

    def errors(
        self,
        context: Context,
        states: Tensor,
        ids: Tensor,
        actions: Tensor,
        noise: Tensor,
        time: Tensor,
        prefix_len: Tensor | None = None,
    ) -> Tensor:
        """Squared errors of the velocity, ``(B * K, T, ori_action_dim)``, K noise samples each.

        Args:
            states: ``(B, S)``; ids: ``(B,)`` int64; actions: ``(B, T, D)`` normalised.
            noise: ``(B, K, T, D)``; time: ``(B, K)`` in 0..1.
            prefix_len: ``(B, K)`` int64: so many actions at the beginning are given, without noise,
                and their errors are 0.
        """
        check_actions("GR00TActionHead", tuple(actions.shape[1:]), (self.horizon, self.action_dim))
        repeats = noise.shape[1]
        encoded = self.encode_context(context).repeat_interleave(repeats)
        state = self.encode_states(states, ids).repeat_interleave(repeats, 0)
        clean = actions[:, None].expand_as(noise)
        t = time[..., None, None]
        mixed = ((1 - t) * noise + t * clean).flatten(0, 1)
        target = (clean - noise).flatten(0, 1)
        given = None
        if prefix_len is not None:
            given = self._first(prefix_len.flatten())
            mixed = torch.where(given[..., None], clean.flatten(0, 1), mixed)
        steps, ids = (time.flatten() * _BUCKETS).long(), ids.repeat_interleave(repeats, 0)
        velocity = self.velocity(mixed, steps, encoded, state, ids, given=given)
        errors = (velocity - target)[..., : self.loss_dim].float().square()
        return errors if given is None else errors * ~given[..., None]

    def loss(self, errors: Tensor, masks: Tensor) -> Tensor:
        """The mean of ``errors`` ``(B * K, T, D)``, where ``masks`` ``(B, T)`` is 0 counted as 0.

        See ``mean_over_valid`` for what it is divided by.
        """
        weights = masks.to(errors.dtype).repeat_interleave(len(errors) // len(masks), 0)[..., None]
        if not self.mean_over_valid:
            return (errors * weights).mean()
        return (errors * weights).sum() / (weights.sum() * errors.shape[-1]).clamp(min=1)

    def sample(
        self,
        context: Context,
        states: Tensor,
        ids: Tensor,
        noise: Tensor,
        guide: Guide | None = None,
        by_prefix: bool = False,
    ) -> Tensor:
        """Integrate from ``noise`` ``(B, T, D)`` to a chunk ``(B, T, D)`` by Euler steps.

        ``guide`` makes it continue another chunk; that takes a backward pass for each step, or,
        ``by_prefix``, none: what is frozen is given, as in training with ``prefix_len``.
        """
        if guide is None:
            return self.denoise(self.observe(context, states, ids), noise, self.step_tables())
        encoded = self.encode_context(context)
        state = self.encode_states(states, ids)
        cache = [KVCache() for _ in range(len(self.dit.blocks) // 2)]
        x = noise
        for step in range(self.num_steps):
            t = step / self.num_steps
            steps = torch.full((len(x),), int(t * _BUCKETS), device=x.device)
            velocity = partial(
                self.velocity, steps=steps, context=encoded, state=state, ids=ids, cache=cache
            )
            if by_prefix:
                x = guide.freeze(x)
                x = x + velocity(x, given=self._first(guide.frozen)) / self.num_steps
                continue
            clean, pull = guide.pull(partial(_estimate, velocity, t), x, t)
            x = x + (clean - x) / (self.num_steps - step) + pull / self.num_steps
        return guide.freeze(x)

    def observe(self, context: Context, states: Tensor, ids: Tensor) -> dict[str, Tensor]:
        """What every integration step needs: state and future tokens (``before``), the KV cache of
        the context, masks, and the weights of the embodiments ``ids`` ``(B,)`` int64.
        """
        encoded = self.encode_context(context)
        before = self.encode_states(states, ids)
        if self.future_tokens is not None:
            future = self.future_tokens.weight.to(before.dtype)
            before = torch.cat([before, future.expand(len(before), -1, -1)], dim=1)
        tensors = {"before": before}
        for pair, mask in enumerate(self._masks(encoded)):
            cache = self.dit.blocks[2 * pair].attention.cache_context(encoded.features)
            assert cache.key is not None
            assert cache.value is not None
            tensors |= {f"key.{pair}": cache.key, f"value.{pair}": cache.value}
            if mask is not None:
                zeros = torch.zeros(mask.shape, dtype=cache.key.dtype, device=mask.device)
                tensors[f"mask.{pair}"] = zeros.masked_fill(~mask, float("-inf"))
        for part, names in _CHOSEN.items():
            module = self.get_submodule(part)
            for name in names:
                weight, bias = module.get_submodule(name).chosen(ids)
                tensors |= {f"{part}.{name}.weight": weight, f"{part}.{name}.bias": bias}
        return tensors

    def denoise(
        self, seen: Mapping[str, Tensor], noise: Tensor, tables: Mapping[str, Tensor]
    ) -> Tensor:
        """All steps by Euler's method: ``noise`` ``(B, T, D)`` -> actions ``(B, T, D)``."""
        pairs = len(self.dit.blocks) // 2
        cache = [KVCache(seen[f"key.{pair}"], seen[f"value.{pair}"]) for pair in range(pairs)]
        masks = [seen.get(f"mask.{pair}") for pair in range(pairs)]
        encode, decode = (
            {n: (seen[f"{part}.{n}.weight"], seen[f"{part}.{n}.bias"]) for n in _CHOSEN[part]}
            for part in ("action_encoder", "action_decoder")
        )
        x, count = noise, noise.shape[1]
        for step in range(self.num_steps):
            actions = self.action_encoder.of(x, tables["waves"][step], encode)
            actions = actions + self.positions.weight[:count].to(actions.dtype)
            joined = torch.cat([seen["before"], actions], dim=1)
            hidden = self.dit.step(joined, tables, step, cache, masks)
            x = x + self.action_decoder.of(hidden[:, -count:], decode) / self.num_steps
        return x

    def step_tables(self) -> dict[str, Tensor]:
        """``waves`` ``(K, W)``, and what ``DiT.step_tables`` has: of the times of all steps."""
        thousandths = [int(step / self.num_steps * _BUCKETS) for step in range(self.num_steps)]
        steps = torch.tensor(thousandths).to(self.positions.weight.device)
        return {"waves": self.action_encoder.waves(steps), **self.dit.step_tables(steps)}

    def fsdp_units(self) -> list[nn.Module]:
        """Blocks to shard one by one."""
        return [*self.context_blocks, *self.dit.blocks]

    def _first(self, length: Tensor) -> Tensor:
        """``(B, T)``, True for the first ``length`` ``(B,)`` actions of a chunk."""
        return torch.arange(self.horizon, device=length.device) < length[:, None]

    def _masks(self, context: Context) -> list[Tensor | None]:
        """The attention mask of each block that attends to the context."""
        pairs = len(self.dit.blocks) // 2
        if self.attend_text_every is None:
            return [None if self.attend_padding else context.mask] * pairs
        text, images = context.mask & ~context.image_mask, context.mask & context.image_mask
        every = self.attend_text_every
        return [images if pair % every else text for pair in range(pairs)]


def _estimate(velocity: Any, t: float, x: Tensor) -> Tensor:
    """The clean chunk behind ``x`` at time ``t``."""
    return x + (1 - t) * velocity(x)


def _check(**numbers: tuple[int, int, int | None]) -> None:
    for name, (value, least, most) in numbers.items():
        if value < least or (most is not None and value > most):
            between = f"at least {least}" if most is None else f"in {least}..{most}"
            raise ConfigError(f"GR00TActionHead: {name} must be {between}, got {value}")
