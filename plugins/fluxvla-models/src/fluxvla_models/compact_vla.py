"""A compact Vision-Language-Action model, put together from the parts that a config names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn

from fluxvla_core.models import (
    VLA,
    InputSizes,
    build_head_from_cfg,
    build_llm_backbone_from_cfg,
    build_projector_from_cfg,
    build_vision_backbone_from_cfg,
)
from fluxvla_models.guidance import Guide


class CompactVLA(VLA, nn.Module):
    """Images, instruction and joint state in, action chunk out.

    With the parts of ``configs/aloha_sim_transfer.py`` 4.0 million parameters are trained, beside
    a frozen sentence encoder of 22.7 million.

    ``forward`` and ``predict_action`` draw nothing: noise and times come in with the batch, so
    the same batch gives the same loss on one process and on many.

    Args:
        vision_backbone: table or module; ``(B, 3N, H, W)`` -> ``(B, out_dim)``.
        llm_backbone: table or module; tokens and masks -> ``(B, out_dim)``.
        projector: table or module; the widths that it joins are filled in here.
        vla_head: table or module; its ``context_dim`` is filled in here.
        state_dim: length of the (padded) state vector.
    """

    input_sizes = InputSizes(
        cameras="vision_backbone.num_cameras",
        image_size="vision_backbone.image_size",
        states="state_dim",
        actions="vla_head.action_dim",
        horizon="vla_head.horizon",
        float_images=True,
    )

    def __init__(
        self,
        vision_backbone: Mapping[str, Any] | nn.Module,
        llm_backbone: Mapping[str, Any] | nn.Module,
        projector: Mapping[str, Any] | nn.Module,
        vla_head: Mapping[str, Any] | nn.Module,
        state_dim: int = 14,
    ) -> None:
        super().__init__()
        self.vision_backbone = build_vision_backbone_from_cfg(vision_backbone)
        self.llm_backbone = build_llm_backbone_from_cfg(llm_backbone)
        self.projector = build_projector_from_cfg(
            projector,
            vision_dim=self.vision_backbone.out_dim,
            text_dim=self.llm_backbone.out_dim,
            state_dim=state_dim,
        )
        self.vla_head = build_head_from_cfg(vla_head, context_dim=self.projector.out_dim)

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
    ) -> dict[str, Tensor]:
        """One training batch -> ``{"loss": scalar}``.

        A head that returns ``errors`` gives ``sample_losses`` ``(B,)`` too, for the records.

        Args:
            images: ``(B, 3N, H, W)`` normalised.
            lang_tokens, lang_masks: ``(B, L)`` int64 and bool.
            states: ``(B, S)`` normalised; ``actions``: ``(B, T, D)`` normalised.
            action_masks: ``(B, T)``, 0 beyond the end of an episode.
            noise: ``(B, K, T, D)``; ``time``: ``(B, K)``: K draws for each sample.
        """
        context = self._context(images, lang_tokens, lang_masks, states)
        if not hasattr(self.vla_head, "errors"):
            return {"loss": self.vla_head.loss(context, actions, action_masks, noise, time)}
        errors = self.vla_head.errors(context, actions, action_masks, noise, time)
        each = errors.detach().reshape(len(actions), -1).mean(1)
        return {"loss": errors.mean(), "sample_losses": each}

    def predict_action(
        self,
        images: Tensor,
        lang_tokens: Tensor,
        lang_masks: Tensor,
        states: Tensor,
        noise: Tensor,
        prev_actions: Tensor | None = None,
        prefix_weights: Tensor | None = None,
        prefix_len: Tensor | None = None,
        max_guidance_weight: Tensor | None = None,
    ) -> Tensor:
        """Observation and ``noise`` ``(B, T, D)`` -> normalised actions ``(B, T, D)``.

        Args:
            prev_actions: ``(B, T, D)`` normalised, to go on from; the other three belong to it,
                see ``guidance.Guide``.
            prefix_weights: ``(B, T)``; prefix_len, max_guidance_weight: ``(B,)``.
        """
        guide = Guide.of(prev_actions, prefix_weights, prefix_len, max_guidance_weight)
        context = self._context(images, lang_tokens, lang_masks, states)
        return self.vla_head.sample(context, noise, guide)

    def observe(
        self, images: Tensor, lang_tokens: Tensor, lang_masks: Tensor, states: Tensor
    ) -> dict[str, Tensor]:
        """What the steps need of an observation: ``context`` ``(B, C)``."""
        return {"context": self._context(images, lang_tokens, lang_masks, states)}

    def denoise(
        self, seen: Mapping[str, Tensor], noise: Tensor, tables: Mapping[str, Tensor]
    ) -> Tensor:
        """All steps of the head: ``noise`` ``(B, T, D)`` -> normalised actions ``(B, T, D)``."""
        return self.vla_head.sample(seen["context"], noise, None)

    @property
    def action_shape(self) -> tuple[int, int]:
        """``(T, D)`` of a chunk, and of the noise that one starts from."""
        return self.vla_head.horizon, self.vla_head.action_dim

    def fsdp_units(self) -> list[nn.Module]:
        """Blocks to shard one by one; the frozen text encoder stays whole."""
        units: list[nn.Module] = []
        for part in (self.vision_backbone, self.projector, self.vla_head):
            units += part.fsdp_units() if hasattr(part, "fsdp_units") else [part]
        return units

    def _context(self, images: Tensor, tokens: Tensor, masks: Tensor, states: Tensor) -> Tensor:
        text = self.llm_backbone(tokens, masks)
        return self.projector(self.vision_backbone(images), text, states)
