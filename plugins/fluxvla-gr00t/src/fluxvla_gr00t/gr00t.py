"""``GR00T``: a vision-language backbone and a flow-matching action head."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from typing import Any

import torch
from fluxvla_models.guidance import Guide
from fluxvla_models.widths import check_prefix_len
from torch import Tensor, nn

from fluxvla_core.errors import ConfigError
from fluxvla_core.models import (
    VLA,
    InputSizes,
    build_head_from_cfg,
    build_vlm_backbone_from_cfg,
)
from fluxvla_gr00t.context import Context


class GR00T(VLA, nn.Module):
    """Images, instruction and joint state in, action chunk out: GR00T N1.5 and N1.7.

    N1.5 is ``EagleBackbone`` and ``GR00TActionHead`` as they are; N1.7 is ``Qwen3VLBackbone`` and
    a ``GR00TActionHead`` with N1.7's numbers (``configs/gr00t_n15_*.py``, ``gr00t_n17_*.py``).

    Args:
        vlm_backbone: table or module; images and tokens -> ``Context``.
        vla_head: table or module; its ``context_dim`` is filled in here.
        freeze_vlm_backbone: train the head alone, as NVIDIA's fine-tuning does by default.
        embodiment_id: the embodiment of batches that do not say theirs.
        pretrained_name_or_path: weights that a training starts from, for instance a published
            checkpoint's folder.
        prefix_conditioning: chunks that continue another are trained for and made by holding their
            beginning (Black et al. 2025, arXiv 2512.05964); without, they are made by guidance.
            Training takes ``prefix_len`` of ``SamplePrefixLength`` then.
    """

    input_sizes = InputSizes(
        image_size="vlm_backbone.image_size",
        states="vla_head.state_dim",
        actions="vla_head.action_dim",
        horizon="vla_head.horizon",
        embodiments="vla_head.embodiments",
        vocabulary="vlm_backbone.vocabulary",
        float_images=True,
    )

    def __init__(
        self,
        vlm_backbone: Mapping[str, Any] | nn.Module,
        vla_head: Mapping[str, Any] | nn.Module,
        freeze_vlm_backbone: bool = True,
        embodiment_id: int = 0,
        pretrained_name_or_path: str | None = None,
        prefix_conditioning: bool = False,
    ) -> None:
        super().__init__()
        self.pretrained_name_or_path = pretrained_name_or_path
        self.vlm_backbone = build_vlm_backbone_from_cfg(vlm_backbone)
        self.vla_head = build_head_from_cfg(vla_head, context_dim=self.vlm_backbone.out_dim)
        self.freeze_vlm_backbone = freeze_vlm_backbone
        self.vlm_backbone.requires_grad_(not freeze_vlm_backbone)
        if not 0 <= embodiment_id < self.vla_head.embodiments:
            raise ConfigError(
                f"GR00T: embodiment_id {embodiment_id} is not in "
                f"0..{self.vla_head.embodiments - 1}, the embodiments that the head has layers for"
            )
        self.embodiment_id = embodiment_id
        self.prefix_conditioning = prefix_conditioning

    def forward(
        self,
        images: Tensor,
        lang_tokens: Tensor,
        lang_masks: Tensor,
        states: Tensor,
        actions: Tensor,
        action_masks: Tensor,
        noise: Tensor,
        time: Tensor,
        img_masks: Tensor | None = None,
        embodiment_ids: Tensor | None = None,
        prefix_len: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """One training batch -> ``{"loss": scalar, "sample_losses": (B,)}``.

        Args:
            images: ``(B, 3N, H, W)`` normalised; img_masks: ``(B, N)`` bool.
            lang_tokens, lang_masks: ``(B, L)`` int64 and bool, with the image tokens of N images.
            states: ``(B, S)`` normalised; actions: ``(B, T, D)`` normalised.
            action_masks: ``(B, T)``, 0 beyond the end of an episode.
            noise: ``(B, K, T, D)``; time: ``(B, K)`` in 0..1: K noise samples each.
            embodiment_ids: ``(B,)`` int64; ``embodiment_id`` without.
            prefix_len: ``(B, K)`` int64: so many actions at the beginning are given, without noise,
                and their errors count as 0, for ``prefix_conditioning``.

        Raises:
            ConfigError: inputs of another shape; ``prefix_len`` without ``prefix_conditioning``, or
                the reverse.
        """
        check_prefix_len(self.prefix_conditioning, prefix_len)
        context = self._context(images, lang_tokens, lang_masks, img_masks)
        ids = self._ids(states, embodiment_ids)
        errors = self.vla_head.errors(context, states, ids, actions, noise, time, prefix_len)
        masked = errors.detach().unflatten(0, (len(states), -1)) * action_masks[:, None, :, None]
        loss = self.vla_head.loss(errors, action_masks)
        return {"loss": loss, "sample_losses": masked.flatten(1).mean(1)}

    def predict_action(
        self,
        images: Tensor,
        lang_tokens: Tensor,
        lang_masks: Tensor,
        states: Tensor,
        noise: Tensor,
        img_masks: Tensor | None = None,
        embodiment_ids: Tensor | None = None,
        prev_actions: Tensor | None = None,
        prefix_weights: Tensor | None = None,
        prefix_len: Tensor | None = None,
        max_guidance_weight: Tensor | None = None,
    ) -> Tensor:
        """Observation and ``noise`` ``(B, T, D)`` -> normalised actions ``(B, T, D)``.

        Args:
            prev_actions: ``(B, T, D)`` normalised, to go on from; the other three belong to it,
                see ``fluxvla_models.guidance.Guide``. With ``prefix_conditioning`` ``prefix_len``
                rows are held, the rest is free.
            prefix_weights: ``(B, T)``; prefix_len, max_guidance_weight: ``(B,)``.
        """
        guide = Guide.of(prev_actions, prefix_weights, prefix_len, max_guidance_weight)
        if guide is None:
            seen = self.observe(images, lang_tokens, lang_masks, states, img_masks, embodiment_ids)
            return self.denoise(seen, noise, self.step_tables())
        context = self._context(images, lang_tokens, lang_masks, img_masks)
        ids = self._ids(states, embodiment_ids)
        return self.vla_head.sample(context, states, ids, noise, guide, self.prefix_conditioning)

    def observe(
        self,
        images: Tensor,
        lang_tokens: Tensor,
        lang_masks: Tensor,
        states: Tensor,
        img_masks: Tensor | None = None,
        embodiment_ids: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """What the steps need of an observation, arguments as of ``predict_action``.

        It checks image tokens and embodiments on the host.
        """
        context = self._context(images, lang_tokens, lang_masks, img_masks)
        return self.vla_head.observe(context, states, self._ids(states, embodiment_ids))

    def denoise(
        self, seen: Mapping[str, Tensor], noise: Tensor, tables: Mapping[str, Tensor]
    ) -> Tensor:
        """All steps: ``noise`` ``(B, T, D)`` -> normalised actions ``(B, T, D)``."""
        return self.vla_head.denoise(seen, noise, tables)

    def step_tables(self) -> Mapping[str, Tensor]:
        """See ``GR00TActionHead.step_tables``."""
        return self.vla_head.step_tables()

    @property
    def action_shape(self) -> tuple[int, int]:
        """``(T, D)`` of a chunk, and of the noise that one starts from."""
        return self.vla_head.horizon, self.vla_head.action_dim

    @property
    def lora_defaults(self) -> dict[str, Any]:
        """The attention of the action head, as NVIDIA's fine-tuning has it."""
        layers = r"vla_head\.(dit\.blocks|context_blocks)\.\d+\.attention\.(query|key|value)"
        return {"target_modules": layers}

    def fsdp_units(self) -> list[nn.Module]:
        """Blocks to shard one by one."""
        return [*self.vlm_backbone.fsdp_units(), *self.vla_head.fsdp_units()]

    def _context(
        self, images: Tensor, tokens: Tensor, masks: Tensor, img_masks: Tensor | None
    ) -> Context:
        with torch.no_grad() if self.freeze_vlm_backbone else nullcontext():
            return self.vlm_backbone(images, tokens, masks, img_masks)

    def _ids(self, states: Tensor, ids: Tensor | None) -> Tensor:
        """``(B,)`` int64, checked: a wrong one would pick another robot's weights, or none."""
        if ids is None:
            return torch.full((len(states),), self.embodiment_id, device=states.device)
        known = self.vla_head.embodiments
        if bool(((ids < 0) | (ids >= known)).any()):
            raise ConfigError(
                f"embodiment_ids {ids.tolist()} are not all in 0..{known - 1}, the embodiments "
                "that the head has layers for",
                next="--set train_dataloader.dataset.embodiment_id=N: the number of the robot",
            )
        return ids.long()
