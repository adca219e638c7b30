"""What OpenVLA and OpenVLA-OFT share: towers, projector and language model (Prismatic-7B)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from fluxvla_core.errors import ConfigError
from fluxvla_core.models import VLA
from fluxvla_openvla.language import Prompt, make_llama, split_prompt
from fluxvla_openvla.sizes import (
    DINOV2_L,
    SIGLIP_SO400M,
    LanguageSize,
    TowerSize,
    read_size,
)
from fluxvla_openvla.vision import DinoSiglip, Projector


class Prismatic(VLA, nn.Module):
    """The vision-language model that both policies are made of.

    Modules are named as in OpenVLA's published weights (Hugging Face layout).

    Args:
        horizon, action_dim: of a chunk.
        num_images: images of an observation.
        image_size: pixels of an image's side.
        dino, siglip, language: sizes, as tables of what differs from OpenVLA-7B's.
        use_film: modulate the vision features by the mean of the prompt's embeddings.

    Raises:
        ConfigError: sizes that do not fit together.
    """

    def __init__(
        self,
        horizon: int,
        action_dim: int,
        num_images: int,
        image_size: int,
        dino: Mapping[str, Any] | TowerSize | None,
        siglip: Mapping[str, Any] | TowerSize | None,
        language: Mapping[str, Any] | LanguageSize | None,
        use_film: bool,
    ) -> None:
        super().__init__()
        who = type(self).__name__
        for name, value in (
            ("horizon", horizon),
            ("action_dim", action_dim),
            ("num_images", num_images),
        ):
            if value < 1:
                raise ConfigError(f"{who}: {name} must be at least 1, got {value}")
        first = read_size(dino, DINOV2_L, f"{who}: dino")
        second = read_size(siglip, SIGLIP_SO400M, f"{who}: siglip")
        self.size = read_size(language, LanguageSize(), f"{who}: language")
        _check(who, image_size, first, second, self.size)
        self.horizon, self.action_dim = horizon, action_dim
        self.num_images, self.image_size = num_images, image_size
        self.use_film = use_film
        width = self.size.hidden_size
        self.vision_backbone = DinoSiglip(first, second, image_size, width if use_film else 0)
        self.projector = Projector(self.vision_backbone.width, width)
        self.language_model = make_llama(self.size)

    def freeze(self, vision: bool, language: bool) -> None:
        """Do not train the two towers, or the language model; the projector is trained."""
        if vision:
            self.vision_backbone.requires_grad_(False)
        if language:
            self.language_model.requires_grad_(False)

    @property
    def action_shape(self) -> tuple[int, int]:
        """``(T, D)`` of a chunk."""
        return self.horizon, self.action_dim

    @property
    def lora_defaults(self) -> dict[str, Any]:
        """Every linear layer that the loss reaches, as OpenVLA's fine-tuning has it."""
        towers = ("featurizer", "fused_featurizer")
        unused = (len(getattr(self.vision_backbone, name).blocks) - 1 for name in towers)
        blocks = (
            rf"vision_backbone\.{name}\.blocks\.(?!{last}\.)\d+\.(attn\.(qkv|proj)|mlp\.fc[12])"
            for name, last in zip(towers, unused, strict=True)
        )
        others = (
            r"vision_backbone\.(fused_)?featurizer\.patch_embed\.proj",
            r"projector\.fc[123]",
            r"language_model\.model\.layers\.\d+\.(self_attn\.[qkvo]_proj|mlp\.(gate|up|down)_proj)",
        )
        return {"target_modules": "|".join([*blocks, *others])}

    def fsdp_units(self) -> list[Any]:
        """Blocks of both towers, the projector and layers of the language model, one by one."""
        vision = self.vision_backbone
        return [
            *vision.featurizer.used_blocks(),
            *vision.fused_featurizer.used_blocks(),
            self.projector,
            *self.language_model.model.layers,
        ]

    def embed(self, tokens: Tensor) -> Tensor:
        """Token ids ``(B, L)`` -> embeddings ``(B, L, width)``."""
        return self.language_model.model.embed_tokens(tokens)

    def encode_images(self, images: Tensor, prompt: Prompt) -> Tensor:
        """Images ``(B, 3N, H, W)`` in -1..1 -> ``(B, N * patches, width)``.

        With FiLM by the mean of the prompt's embeddings, the stop token's among them, padding not.
        OpenVLA-OFT's code averages the padding of shorter prompts in a batch too, which made
        a sample's loss depend on its company; alone in a batch both are the same.
        """
        if not self.use_film:
            return self.projector(self.vision_backbone(images))
        mask = prompt.mask.unsqueeze(-1)
        ends = self.embed(torch.cat([prompt.first, self.stop_tokens(len(images))], 1)).sum(1)
        total = ends + (self.embed(prompt.rest) * mask).sum(1)
        return self.projector(self.vision_backbone(images, total / (mask.sum(1) + 2)))

    def stop_tokens(self, batch: int) -> Tensor:
        """``(batch, 1)`` int64."""
        device = self.language_model.model.embed_tokens.weight.device
        return torch.full((batch, 1), self.size.stop_token, device=device)

    def read_prompt(self, images: Tensor, lang_tokens: Tensor, lang_masks: Tensor) -> Prompt:
        """Check the images and split the prompt.

        Raises:
            ConfigError: another number of images, or another size.
        """
        expected = (3 * self.num_images, self.image_size, self.image_size)
        if tuple(images.shape[1:]) != expected:
            raise ConfigError(
                f"{type(self).__name__}: images have shape {tuple(images.shape[1:])}, "
                f"{self.num_images} x 3 planes of {self.image_size} x {self.image_size} "
                "are expected",
                cause="img_keys and num_images disagree, or no transform resizes the images",
                next="let img_keys name as many cameras as num_images says, and put "
                "ResizeOpenVLAImages into the transforms",
            )
        return split_prompt(lang_tokens, lang_masks)

    def check_actions(self, actions: Tensor) -> None:
        """Compare the shape of ``actions`` with ``action_shape``.

        Raises:
            ConfigError: they differ.
        """
        if tuple(actions.shape[1:]) != self.action_shape:
            raise ConfigError(
                f"{type(self).__name__}: actions have shape {tuple(actions.shape[1:])}, the model "
                f"has horizon {self.horizon} and action_dim {self.action_dim}",
                cause="the model was made for another robot, or action_window_size is another",
                next="let action_window_size be the model's horizon, and action_dim the width of "
                "the dataset's actions",
            )


def _check(
    who: str, image_size: int, dino: TowerSize, siglip: TowerSize, language: LanguageSize
) -> None:
    if dino.patch_size != siglip.patch_size or image_size % dino.patch_size:
        raise ConfigError(
            f"{who}: images of {image_size} pixels, patches of {dino.patch_size} (dino) and "
            f"{siglip.patch_size} (siglip): both towers must cut an image into the same whole "
            "patches"
        )
    for name, size in (("dino", dino), ("siglip", siglip)):
        if size.depth < 2 or size.num_heads < 1 or size.width % size.num_heads:
            raise ConfigError(
                f"{who}: {name} needs a depth of 2 or more and a width that its heads divide, got "
                f"depth {size.depth}, width {size.width}, num_heads {size.num_heads}"
            )
    if not 256 < language.text_vocab_size <= language.vocab_size:
        raise ConfigError(
            f"{who}: language.text_vocab_size {language.text_vocab_size} must be above 256, the "
            f"tokens of actions, and at most vocab_size {language.vocab_size}"
        )
