"""A VLA composed of pretrained parts: a vision-language model, or its two halves, and a head."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from fluxvla_core.errors import ConfigError
from fluxvla_core.models import (
    VLA,
    InputSizes,
    PartWeights,
    build_head_from_cfg,
    build_llm_backbone_from_cfg,
    build_projector_from_cfg,
    build_vision_backbone_from_cfg,
    build_vlm_backbone_from_cfg,
)

Part = Mapping[str, Any] | nn.Module


def _image_size(sizes: Mapping[str, Any] | None) -> int | None:
    """Of a vision tower's ``sizes``, or those of a model that has one."""
    vision = sizes.get("vision_config", sizes) if sizes else {}
    return vision.get("image_size")


class LlavaVLA(VLA, nn.Module):
    """Images and an instruction through a vision-language model, its hidden states to actions.

    Either ``vlm_backbone``, or ``vision_backbone``, ``projector`` and ``llm_backbone``, whose input
    are then the projected patches followed by the instruction (Liu et al. 2023, LLaVA).

    Args:
        vision_backbone: ``(B, 3N, H, W)`` -> ``(B, L, out_dim)``.
        projector: ``(B, L, in_dim)`` -> ``(B, L, out_dim)``; both widths are filled in here.
        llm_backbone: ``embed(tokens)``, and embeddings and masks -> ``(B, L, out_dim)``.
        vlm_backbone: images, img_masks, tokens and masks -> ``(B, L, out_dim)`` and masks.
        vla_head: as ``LlavaActionHead``; its ``context_dim`` is filled in here.
        freeze_vision_backbone, freeze_llm_backbone, freeze_vlm_backbone, freeze_projector: keep a
            part as it is.
        pretrained_name_or_path: where a training starts from, as ``runner.init_from``; with
            ``name_mapping`` weights of parts: see ``PartWeights.place``.
        name_mapping: a part of a weight's name here -> what stands there instead in that place.
            Weights whose names have none of them are drawn anew.
        strict_mapping: tensors there that nothing here needs are an error. A weight that is
            missing there, or has another size, always is one.

    Raises:
        ConfigError: parts that do not go together, or a ``name_mapping`` of no place.
    """

    input_sizes = InputSizes(
        cameras="vision_backbone.num_cameras | vlm_backbone.num_cameras",
        image_size=("vision_backbone.sizes | vlm_backbone.sizes", _image_size),
        states="vla_head.state_dim",
        actions="vla_head.action_dim",
        horizon="vla_head.horizon",
        vocabulary="llm_backbone.sizes.vocab_size | vlm_backbone.sizes.text_config.vocab_size",
        float_images=True,
    )

    def __init__(
        self,
        vla_head: Part,
        vision_backbone: Part | None = None,
        projector: Part | None = None,
        llm_backbone: Part | None = None,
        vlm_backbone: Part | None = None,
        freeze_vision_backbone: bool = False,
        freeze_llm_backbone: bool = False,
        freeze_vlm_backbone: bool = False,
        freeze_projector: bool = False,
        pretrained_name_or_path: str | None = None,
        name_mapping: Mapping[str, str] | None = None,
        strict_mapping: bool = True,
    ) -> None:
        super().__init__()
        if name_mapping is not None and (pretrained_name_or_path is None or not name_mapping):
            raise ConfigError(
                "LlavaVLA: name_mapping says how weights are called in pretrained_name_or_path; "
                "both are needed, with at least one name"
            )
        halves = {
            "vision_backbone": vision_backbone,
            "projector": projector,
            "llm_backbone": llm_backbone,
        }
        given = [name for name, part in halves.items() if part is not None]
        if len(given) != (3 if vlm_backbone is None else 0):
            names = ", ".join([*given, *(["vlm_backbone"] if vlm_backbone is not None else [])])
            raise ConfigError(
                "LlavaVLA takes vlm_backbone, or all of vision_backbone, projector and "
                f"llm_backbone; it was given {names or 'none of them'}"
            )
        frozen = {
            "vision_backbone": freeze_vision_backbone,
            "projector": freeze_projector,
            "llm_backbone": freeze_llm_backbone,
            "vlm_backbone": freeze_vlm_backbone,
        }
        used = ["vlm_backbone"] if vlm_backbone is not None else given
        unused = [name for name, freeze in frozen.items() if freeze and name not in used]
        if unused:
            raise ConfigError(f"freeze_{unused[0]}: the model has no {unused[0]}")
        if vlm_backbone is not None:
            self.vlm_backbone = build_vlm_backbone_from_cfg(vlm_backbone)
            width = self.vlm_backbone.out_dim
        else:
            self.vision_backbone = build_vision_backbone_from_cfg(vision_backbone)
            self.llm_backbone = build_llm_backbone_from_cfg(llm_backbone)
            width = self.llm_backbone.out_dim
            self.projector = build_projector_from_cfg(
                projector, in_dim=self.vision_backbone.out_dim, out_dim=width
            )
        self.vla_head = build_head_from_cfg(vla_head, context_dim=width)
        self.part_weights: tuple[PartWeights, ...] = ()
        if name_mapping is not None and pretrained_name_or_path is not None:
            unread = () if strict_mapping else ("",)
            self.part_weights = (PartWeights(pretrained_name_or_path, dict(name_mapping), unread),)
        self.pretrained_name_or_path = None if self.part_weights else pretrained_name_or_path
        self._parts = [*used, "vla_head"]
        self._frozen = [name for name in used if frozen[name]]
        for name in self._frozen:
            self.get_submodule(name).requires_grad_(False)

    def train(self, mode: bool = True) -> LlavaVLA:
        """Frozen parts stay in evaluation mode."""
        super().train(mode)
        for name in self._frozen:
            self.get_submodule(name).eval()
        return self

    def forward(
        self,
        images: Tensor,
        lang_tokens: Tensor,
        lang_masks: Tensor,
        states: Tensor,
        actions: Tensor,
        action_masks: Tensor,
        img_masks: Tensor | None = None,
        noise: Tensor | None = None,
        time: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """One training batch -> ``{"loss": scalar, "sample_losses": (B,)}``.

        Args:
            images: ``(B, 3N, H, W)`` in -1..1; img_masks: ``(B, N)`` bool, all True if None.
            lang_tokens, lang_masks: ``(B, L)`` int64 and bool.
            states: ``(B, S)``, actions: ``(B, T, D)``, normalised; action_masks: ``(B, T)``.
            noise, time: ``(B, K, T, D)`` and ``(B, K)``, for heads that need them.
        """
        hidden, masks = self._hidden(images, img_masks, lang_tokens, lang_masks)
        errors = self.vla_head.errors(hidden, masks, states, actions, action_masks, noise, time)
        each = errors.detach().reshape(len(actions), -1).mean(1)
        return {"loss": errors.mean(), "sample_losses": each}

    def predict_action(
        self,
        images: Tensor,
        lang_tokens: Tensor,
        lang_masks: Tensor,
        states: Tensor,
        img_masks: Tensor | None = None,
        noise: Tensor | None = None,
    ) -> Tensor:
        """Observation -> normalised actions ``(B, T, D)``; ``noise`` for heads that need it."""
        hidden, masks = self._hidden(images, img_masks, lang_tokens, lang_masks)
        return self.vla_head.sample(hidden, masks, states, noise)

    @property
    def action_shape(self) -> tuple[int, int]:
        """``(T, D)`` of a chunk."""
        return self.vla_head.horizon, self.vla_head.action_dim

    def checkpoint_table(self, table: Mapping[str, Any]) -> Mapping[str, Any]:
        """``table`` with the sizes of pretrained parts, whose folders a checkpoint does without."""
        parts = {name: getattr(self.get_submodule(name), "sizes", None) for name in self._parts}
        sized = {
            name: {**table[name], "sizes": sizes}
            for name, sizes in parts.items()
            if sizes is not None and isinstance(table.get(name), Mapping)
        }
        return {**table, **sized}

    @property
    def lora_defaults(self) -> dict[str, Any]:
        """Every linear layer of the language model; projector and head are trained as a whole."""
        layers = (
            r"(llm_backbone\.model|vlm_backbone\.model\.language_model)\.layers\.\d+"
            r"\.(self_attn\.[qkvo]_proj|mlp\.(gate|up|down)_proj)"
        )
        whole = [name for name in ("projector", "vla_head") if name in self._parts]
        return {"target_modules": layers, "modules_to_save": whole}

    def fsdp_units(self) -> list[nn.Module]:
        """Blocks to shard one by one."""
        units: list[nn.Module] = []
        for name in self._parts:
            part = self.get_submodule(name)
            units += part.fsdp_units() if hasattr(part, "fsdp_units") else [part]
        return units

    def _hidden(
        self, images: Tensor, img_masks: Tensor | None, tokens: Tensor, masks: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Hidden states ``(B, L, C)`` of image and text tokens, and their padding mask."""
        cameras = images.shape[1] // 3
        present = masks.new_ones(len(images), cameras) if img_masks is None else img_masks.bool()
        if "vlm_backbone" in self._parts:
            return self.vlm_backbone(images, present, tokens, masks)
        features = self.projector(self.vision_backbone(images))
        embeddings = torch.cat([features, self.llm_backbone.embed(tokens)], dim=1)
        image_mask = present.repeat_interleave(features.shape[1] // cameras, 1)
        mask = torch.cat([image_mask, masks], dim=1)
        return self.llm_backbone(embeddings, mask), mask
