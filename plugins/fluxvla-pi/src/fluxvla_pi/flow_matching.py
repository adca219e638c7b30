"""What PI0 and PI0.5 share: a vision-language model joined with an action expert, and their flow.

The time ``tau`` here is that of the papers' code: 1 is noise and 0 data, ``x = tau * noise + (1 -
tau) * actions``, and the network predicts the velocity ``noise - actions``. Batches have the time
of ``SampleFlowNoise``, which is ``1 - tau``.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from fluxvla_models.folded_attention import folded_mask
from fluxvla_models.guidance import Guide
from fluxvla_models.velocity import sample
from fluxvla_models.widths import check_actions, check_prefix_len
from torch import Tensor, nn

from fluxvla_core.errors import ConfigError
from fluxvla_core.models import VLA, InputSizes
from fluxvla_pi.acting import Seen, expert_step, seen_of
from fluxvla_pi.gemma import LINEAR_LAYERS, GemmaDecoder, Rope, rope_of
from fluxvla_pi.paligemma import Prefix, embed_prefix
from fluxvla_pi.siglip import SiglipVisionTower
from fluxvla_pi.sizes import gemma_size, image_side, siglip_size

MIN_PERIOD, MAX_PERIOD = 4e-3, 4.0


@dataclass(frozen=True)
class Suffix:
    """State and noisy actions as the expert's layers take them.

    Args:
        hidden: ``(B, S, W)``, of which the last T are actions.
        condition: ``(B, W)`` or ``(B, S, W)`` for adaptive normalisation; None without.
        blocks: ``(S,)``: a token attends to those whose number is not larger than its own.
    """

    hidden: Tensor
    condition: Tensor | None
    blocks: Tensor

    def mask(self, real: Tensor) -> Tensor:
        """``(B, 1, S, P + S)``: the prefix's ``real`` tokens, and its own by blocks."""
        own = self.blocks[None, :] <= self.blocks[:, None]
        size, batch = len(self.blocks), len(real)
        seen = real[:, None, None].expand(-1, 1, size, -1)
        return torch.cat([seen, own.expand(batch, 1, size, size)], dim=-1)

    def rope_positions(self, real: Tensor) -> Tensor:
        """``(B, S)``, going on from the prefix's."""
        steps = torch.arange(self.hidden.shape[1], device=real.device)
        return real.long().sum(1, keepdim=True) + steps


class PiFlowMatching(VLA, nn.Module):
    """A vision-language model joined layer by layer with an action expert.

    ``forward`` and ``predict_action`` draw nothing: noise and times come in with the batch.

    Args:
        variant: size of the language model: ``gemma_2b``, or a table as ``sizes.GemmaSize``.
        expert_variant: size of the action expert, ``gemma_300m``; as deep as the language model,
            with the same heads.
        vision_variant: size of the vision tower, ``so400m``, or a table as ``sizes.SiglipSize``.
        n_action_steps: actions in a chunk.
        max_action_dim: width of (padded) actions.
        ori_action_dim: so many of them count in the loss; all if None, as openpi has it (LeRobot
            counts the robot's own).
        num_steps: Euler steps from noise to actions.
        prefix_conditioning: chunks that continue another are trained for and made by holding their
            beginning (Black et al. 2025, arXiv 2512.05964); without, they are made by guidance.
            Training takes ``prefix_len`` of ``SamplePrefixLength`` then.
        vocab_size: words of the language model.
        freeze_vision_backbone: do not train the vision tower and its projector.
        freeze_llm_backbone: do not train the language model.
        pretrained_name_or_path: what a training starts from, as ``runner.init_from`` takes it.

    Raises:
        ConfigError: sizes that do not belong together.
    """

    adaptive: bool
    """Whether the time enters by adaptive normalisation."""
    projections: ClassVar[Sequence[str]]
    """The layers around the expert, which adapters do not suffice for."""
    input_sizes = InputSizes(
        image_size=("vision_variant", image_side),
        actions="max_action_dim",
        horizon="n_action_steps",
        vocabulary="vocab_size",
        float_images=True,
    )

    def __init__(
        self,
        variant: str | Mapping[str, int] = "gemma_2b",
        expert_variant: str | Mapping[str, int] = "gemma_300m",
        vision_variant: str | Mapping[str, int] = "so400m",
        n_action_steps: int = 50,
        max_action_dim: int = 32,
        ori_action_dim: int | None = None,
        num_steps: int = 10,
        prefix_conditioning: bool = False,
        vocab_size: int = 257152,
        freeze_vision_backbone: bool = False,
        freeze_llm_backbone: bool = False,
        pretrained_name_or_path: str | None = None,
    ) -> None:
        super().__init__()
        self.pretrained_name_or_path = pretrained_name_or_path
        llm, expert = gemma_size(variant, "variant"), gemma_size(expert_variant, "expert_variant")
        vision = siglip_size(vision_variant, "vision_variant")
        for name in ("depth", "heads", "kv_heads", "head_dim"):
            one, other = getattr(llm, name), getattr(expert, name)
            if one != other:
                raise ConfigError(
                    f"variant and expert_variant: {name} is {one} and {other}; "
                    "two that share an attention must have the same"
                )
        if expert.width % 2:
            raise ConfigError(f"expert_variant: width {expert.width} must be even")
        if min(n_action_steps, max_action_dim, num_steps, vocab_size) < 1:
            raise ConfigError(
                f"n_action_steps {n_action_steps}, max_action_dim {max_action_dim}, "
                f"num_steps {num_steps} and vocab_size {vocab_size} must be at least 1"
            )
        if ori_action_dim is not None and not 1 <= ori_action_dim <= max_action_dim:
            raise ConfigError(
                f"ori_action_dim {ori_action_dim} is not in 1..{max_action_dim} (max_action_dim)"
            )
        self.n_action_steps, self.max_action_dim = n_action_steps, max_action_dim
        self.ori_action_dim, self.num_steps = ori_action_dim, num_steps
        self.prefix_conditioning = prefix_conditioning
        self.vision_backbone = SiglipVisionTower(vision)
        self.projector = nn.Linear(vision.width, llm.width)
        self.llm_backbone = GemmaDecoder(llm, vocab_size, keys_only=True)
        self.llm_expert = GemmaDecoder(expert, adaptive=self.adaptive)
        self.action_in_proj = nn.Linear(max_action_dim, expert.width)
        self.action_out_proj = nn.Linear(expert.width, max_action_dim)
        if freeze_vision_backbone:
            self.vision_backbone.requires_grad_(False)
            self.projector.requires_grad_(False)
        if freeze_llm_backbone:
            self.llm_backbone.requires_grad_(False)

    @abstractmethod
    def embed_suffix(self, states: Tensor, x: Tensor, tau: Tensor) -> Suffix:
        """State ``(B, S)`` and noisy actions ``(B, T, D)`` as tokens.

        ``tau`` is ``(B,)``, or ``(B, T)`` where each action has a time of its own.
        """

    @property
    def action_shape(self) -> tuple[int, int]:
        """``(T, D)`` of a chunk, and of the noise that one starts from."""
        return self.n_action_steps, self.max_action_dim

    def fsdp_units(self) -> list[nn.Module | tuple[nn.Module, ...]]:
        """The layers of the vision tower, and pairs of the language model's and the expert's."""
        pairs = zip(self.llm_backbone.layers, self.llm_expert.layers, strict=True)
        return [*self.vision_backbone.layers, *pairs]

    @property
    def lora_defaults(self) -> dict[str, Any]:
        """Every linear layer of both transformers that the loss reaches."""
        last = len(self.llm_backbone.layers) - 1
        # Of the language model's last layer, only keys and values are used.
        targets = (
            rf"(llm_expert\.layers\.\d+|llm_backbone\.layers\.(?!{last}\.)\d+)\.{LINEAR_LAYERS}"
            rf"|llm_backbone\.layers\.{last}\.self_attn\.[kv]_proj"
        )
        return {"target_modules": targets, "modules_to_save": self.projections}

    def forward(
        self,
        images: Tensor,
        lang_tokens: Tensor,
        lang_masks: Tensor,
        states: Tensor,
        actions: Tensor,
        noise: Tensor,
        time: Tensor,
        action_masks: Tensor | None = None,
        img_masks: Tensor | None = None,
        prefix_len: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """One training batch -> ``{"loss": scalar, "sample_losses": (B,)}``.

        The loss is the mean of the squared errors of the velocity. Actions beyond the end of an
        episode count as 0 in it; the references, which know no masks, count them.

        Args:
            images: ``(B, 3N, H, W)`` in -1..1.
            lang_tokens, lang_masks: ``(B, L)`` int64 and bool.
            states: ``(B, S)`` normalised; ``actions``: ``(B, T, D)`` normalised.
            noise: ``(B, K, T, D)``; ``time``: ``(B, K)``, 0 is noise: K draws for each sample.
            action_masks: ``(B, T)``, 0 beyond the end of an episode.
            img_masks: ``(B, N)``, False for a camera that is not there.
            prefix_len: ``(B, K)`` int64: so many actions at the beginning are given, without noise
                and not counted, for ``prefix_conditioning``.

        Raises:
            ConfigError: chunks of another shape than the model's, or ``prefix_len`` without
                ``prefix_conditioning`` or the reverse.
        """
        self._check(actions, "actions")
        check_prefix_len(self.prefix_conditioning, prefix_len)
        draws = noise.shape[1]
        tau = (1.0 - time).flatten()
        noise, clean = noise.flatten(0, 1), actions.repeat_interleave(draws, 0)
        given = None
        if prefix_len is not None:
            given = self._first(prefix_len.flatten())
            tau = torch.where(given, 0.0, tau[:, None])
        share = tau[..., None] if tau.ndim == 2 else tau[:, None, None]
        x = share * noise + (1.0 - share) * clean
        prefix = self.embed_prefix(images, img_masks, lang_tokens, lang_masks)
        suffix = self.embed_suffix(states.repeat_interleave(draws, 0), x, tau)
        velocity = self._joint(prefix, suffix, draws)
        errors = (noise - clean - velocity).square()
        if given is not None:
            errors = errors * ~given[..., None]
        if action_masks is not None:
            errors = errors * action_masks.repeat_interleave(draws, 0)[..., None]
        errors = errors[..., : self.ori_action_dim]
        each = errors.detach().reshape(len(actions), -1).mean(1)
        return {"loss": errors.mean(), "sample_losses": each}

    def predict_action(
        self,
        images: Tensor,
        lang_tokens: Tensor,
        lang_masks: Tensor,
        states: Tensor,
        noise: Tensor,
        img_masks: Tensor | None = None,
        prev_actions: Tensor | None = None,
        prefix_weights: Tensor | None = None,
        prefix_len: Tensor | None = None,
        max_guidance_weight: Tensor | None = None,
    ) -> Tensor:
        """Observation and ``noise`` ``(B, T, D)`` -> normalised actions ``(B, T, D)``.

        What is seen and asked is computed once, and its keys and values serve every step.

        Args:
            prev_actions: ``(B, T, D)`` normalised, to go on from; the other three belong to it,
                see ``fluxvla_models.guidance.Guide``. Padding is not pulled where the loss leaves
                it out. With ``prefix_conditioning`` ``prefix_len`` rows are held, the rest is free.
            prefix_weights: ``(B, T)``; prefix_len, max_guidance_weight: ``(B,)``.
        """
        own = None if self.prefix_conditioning else self.ori_action_dim
        guide = Guide.of(prev_actions, prefix_weights, prefix_len, max_guidance_weight, own)
        if guide is None:
            seen = self.observe(images, lang_tokens, lang_masks, states, img_masks)
            return self.denoise(seen, noise, self.step_tables())
        self._check(noise, "noise")
        prefix = self.embed_prefix(images, img_masks, lang_tokens, lang_masks)
        known = self._keys_and_values(prefix)
        held = guide if self.prefix_conditioning else None

        def velocity(x: Tensor, tau: Tensor) -> Tensor:
            if held is not None:
                x = held.freeze(x)
                tau = torch.where(self._first(held.frozen), 0.0, tau[:, None])
            return self._velocity(x, tau, states, prefix.real, known)

        if held is not None:
            return held.freeze(sample(velocity, noise, self.num_steps))
        return sample(velocity, noise, self.num_steps, guide)

    def observe(
        self,
        images: Tensor,
        lang_tokens: Tensor,
        lang_masks: Tensor,
        states: Tensor,
        img_masks: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """What the steps need of an observation, arguments as of ``predict_action``: ``Seen``."""
        prefix = self.embed_prefix(images, img_masks, lang_tokens, lang_masks)
        known = self._keys_and_values(prefix, folded=True)
        own = self.attended(states.device)
        places = torch.arange(own.shape[1], device=states.device)
        rope = self._rope(prefix.real.long().sum(1, keepdim=True) + places)
        groups = self.llm_expert.layers[0].groups
        state = self.state_tokens(states)
        return seen_of(known, prefix.real, own, rope, groups, state).to_tensors()

    def denoise(
        self, seen: Mapping[str, Tensor], noise: Tensor, tables: Mapping[str, Tensor]
    ) -> Tensor:
        """All steps by Euler's method: ``noise`` ``(B, T, D)`` -> actions ``(B, T, D)``."""
        self._check(noise, "noise")
        shared, x = Seen.of(seen, len(self.llm_expert.layers)), noise
        for step in range(self.num_steps):
            hidden = self.tokens_at(x, shared, tables, step)
            normed = expert_step(self.llm_expert, hidden, shared, tables, step)
            x = x - self._out(normed) / self.num_steps
        return x

    @property
    def observe_is_capturable(self) -> bool:
        """It reads nothing back to the host."""
        return True

    def exact_modules(self) -> list[nn.Module]:
        """The velocity is not rounded to bf16."""
        return [self.action_out_proj]

    @abstractmethod
    def step_tables(self) -> dict[str, Tensor]:
        """What follows from the times of the steps and the weights."""

    @abstractmethod
    def tokens_at(self, x: Tensor, seen: Seen, tables: Mapping[str, Tensor], step: int) -> Tensor:
        """The expert's tokens ``(B, S, W)`` for noisy actions ``x`` ``(B, T, D)`` in a step."""

    @abstractmethod
    def attended(self, device: torch.device) -> Tensor:
        """``(R, S)`` bool: which of the expert's tokens each attends to; one row if all alike."""

    def state_tokens(self, states: Tensor) -> Tensor | None:
        """``(B, S)`` -> ``(B, 1, W)``; None where the state stands in the prompt."""
        return None

    def embed_prefix(
        self,
        images: Tensor,
        img_masks: Tensor | None,
        lang_tokens: Tensor,
        lang_masks: Tensor,
    ) -> Prefix:
        """Images ``(B, 3N, H, W)`` and words ``(B, L)`` as one row of tokens, images first."""
        parts = (self.vision_backbone, self.projector, self.llm_backbone)
        return embed_prefix(*parts, images, img_masks, lang_tokens, lang_masks)

    def _joint(self, prefix: Prefix, suffix: Suffix, draws: int) -> Tensor:
        """The velocity ``(B * K, T, D)``, both run layer by layer."""
        seen, x = prefix.hidden, suffix.hidden
        rope, mask = self._rope(prefix.rope_positions), prefix.mask
        real = prefix.real.repeat_interleave(draws, 0)
        own_rope, own_mask = self._rope(suffix.rope_positions(real)), suffix.mask(real)
        pairs = zip(self.llm_backbone.layers, self.llm_expert.layers, strict=True)
        for layer, expert in pairs:
            seen, keys, values = layer(seen, rope, mask)
            if draws > 1:
                keys, values = (part.repeat_interleave(draws, 0) for part in (keys, values))
            x, _, _ = expert(x, own_rope, own_mask, keys, values, suffix.condition)
        return self._project(x, suffix)

    def _keys_and_values(self, prefix: Prefix, folded: bool = False) -> list[tuple[Tensor, Tensor]]:
        """Those of every layer of the language model; ``folded``: see ``GemmaLayer``."""
        seen, rope, known = prefix.hidden, self._rope(prefix.rope_positions), []
        groups = self.llm_backbone.layers[0].groups
        mask = folded_mask(prefix.mask, groups, seen.dtype) if folded else prefix.mask
        for layer in self.llm_backbone.layers:
            seen, keys, values = layer(seen, rope, mask, folded=folded)
            known.append((keys, values))
        return known

    def _velocity(
        self,
        x: Tensor,
        tau: Tensor,
        states: Tensor,
        real: Tensor,
        known: list[tuple[Tensor, Tensor]],
    ) -> Tensor:
        """The velocity at ``x`` ``(B, T, D)``, ``known`` being the language model's."""
        suffix = self.embed_suffix(states, x, tau)
        rope, mask = self._rope(suffix.rope_positions(real)), suffix.mask(real)
        hidden = suffix.hidden
        for layer, (keys, values) in zip(self.llm_expert.layers, known, strict=True):
            hidden, _, _ = layer(hidden, rope, mask, keys, values, suffix.condition)
        return self._project(hidden, suffix)

    def _project(self, hidden: Tensor, suffix: Suffix) -> Tensor:
        hidden, _ = self.llm_expert.norm(hidden, suffix.condition)
        return self._out(hidden)

    def _out(self, hidden: Tensor) -> Tensor:
        # The velocity is summed up over the steps, so it is not rounded to bf16 but where sharding
        # gathers the weights so.
        last = hidden[:, -self.n_action_steps :].to(self.action_out_proj.weight.dtype)
        exact = nullcontext() if last.is_meta else torch.autocast(last.device.type, enabled=False)
        with exact:
            return self.action_out_proj(last).float()

    def _first(self, length: Tensor) -> Tensor:
        """``(B, T)``, True for the first ``length`` ``(B,)`` actions of a chunk."""
        return torch.arange(self.n_action_steps, device=length.device) < length[:, None]

    def _rope(self, positions: Tensor) -> Rope:
        return rope_of(positions, self.llm_expert.size.head_dim)

    def _check(self, chunk: Tensor, what: str) -> None:
        check_actions(type(self).__name__, tuple(chunk.shape[1:]), self.action_shape, what)


def time_features(tau: Tensor, width: int) -> Tensor:
    """Sines and cosines ``(..., width)`` float32 of ``tau`` ``(...)``, periods from 0.004 to 4."""
    share = torch.linspace(0.0, 1.0, width // 2, dtype=torch.float64, device=tau.device)
    period = MIN_PERIOD * (MAX_PERIOD / MIN_PERIOD) ** share
    angles = tau.double()[..., None] * (2.0 * math.pi / period)
    return torch.cat([angles.sin(), angles.cos()], dim=-1).float()
