"""Eagle 2.5, the vision-language model of GR00T N1.5: SigLIP2, a linear layer, layers of Qwen3."""

from __future__ import annotations

from torch import Tensor, nn
from transformers import Qwen3Config, Qwen3Model, SiglipVisionConfig, SiglipVisionModel

from fluxvla_core.errors import ConfigError
from fluxvla_gr00t.context import Context
from fluxvla_gr00t.image_tokens import (
    image_token_of,
    image_token_positions,
    merge_image_features,
)


class EagleBackbone(nn.Module):
    """Images and tokens to hidden states; the defaults are those of GR00T N1.5.

    The vision tower is SigLIP2's without its pooling head, the language model Qwen3-1.7B's first
    layers and its last norm. Weights of the published model that nothing here reads (the pooling
    head, the output layer over words) are not in it.

    Args:
        image_size, patch_size: pixels of an image's side and of a patch's; an image takes
            ``(image_size / patch_size)^2`` tokens of the prompt: 256.
        vision_dim, vision_layers, vision_heads, vision_mlp: the vision tower.
        text_dim, text_layers, text_heads, text_kv_heads, text_head_dim, text_mlp, vocabulary: the
            language model; ``text_layers`` is the published ``select_layer``.
        rope_theta: base of its rotary positions.
        image_token: the token that stands for a part of an image, ``<IMG_CONTEXT>``.
    """

    def __init__(
        self,
        image_size: int = 224,
        patch_size: int = 14,
        vision_dim: int = 1152,
        vision_layers: int = 27,
        vision_heads: int = 16,
        vision_mlp: int = 4304,
        text_dim: int = 2048,
        text_layers: int = 12,
        text_heads: int = 16,
        text_kv_heads: int = 8,
        text_head_dim: int = 128,
        text_mlp: int = 6144,
        vocabulary: int = 151680,
        rope_theta: float = 1e6,
        image_token: int = 151669,
        picture_token: int | None = None,
    ) -> None:
        super().__init__()
        if image_size % patch_size:
            raise ConfigError(
                f"EagleBackbone: image_size {image_size} is not a multiple of patch_size "
                f"{patch_size}"
            )
        image_token = image_token_of("EagleBackbone", image_token, picture_token, vocabulary)
        self.out_dim = text_dim
        self.image_size = image_size
        self.image_token = image_token
        self.tokens_per_image = (image_size // patch_size) ** 2
        self.vision = SiglipVisionModel(
            SiglipVisionConfig(
                image_size=image_size,
                patch_size=patch_size,
                hidden_size=vision_dim,
                num_hidden_layers=vision_layers,
                num_attention_heads=vision_heads,
                intermediate_size=vision_mlp,
                vision_use_head=False,
                attn_implementation="sdpa",
            )
        )
        self.connect = nn.Linear(vision_dim, text_dim)
        self.text = Qwen3Model(
            Qwen3Config(
                vocab_size=vocabulary,
                hidden_size=text_dim,
                num_hidden_layers=text_layers,
                num_attention_heads=text_heads,
                num_key_value_heads=text_kv_heads,
                head_dim=text_head_dim,
                intermediate_size=text_mlp,
                rms_norm_eps=1e-6,
                rope_parameters={"rope_type": "default", "rope_theta": rope_theta},
                attn_implementation="sdpa",
                use_cache=False,
            )
        )

    def forward(
        self, images: Tensor, lang_tokens: Tensor, lang_masks: Tensor, img_masks: Tensor | None
    ) -> Context:
        """Hidden states of the language model after its final norm.

        Args:
            images: ``(B, 3N, H, W)`` normalised.
            lang_tokens, lang_masks: ``(B, L)`` int64 and bool, with the image tokens of N images.
            img_masks: ``(B, N)`` bool, False where a camera's image is absent; None: all there.

        Raises:
            ConfigError: images of another size, or image tokens of another number.
        """
        count = _count(images, self.image_size)
        image_mask, mask = image_token_positions(
            lang_tokens, lang_masks, img_masks, self.image_token, count, self.tokens_per_image
        )
        pixels = images.unflatten(1, (count, 3)).flatten(0, 1)
        features = self.connect(self.vision(pixel_values=pixels).last_hidden_state)
        embeddings = self.text.embed_tokens(lang_tokens)
        embeddings = merge_image_features(embeddings, image_mask, features.flatten(0, 1))
        # Positions count real tokens alone, so that padding shifts nothing.
        positions = (lang_masks.long().cumsum(1) - 1).clamp(min=0)
        output = self.text(
            inputs_embeds=embeddings,
            attention_mask=mask.long(),
            position_ids=positions,
            use_cache=False,
        )
        return Context(output.last_hidden_state, mask, image_mask)

    def fsdp_units(self) -> list[nn.Module]:
        """Blocks to shard one by one."""
        return [*self.vision.encoder.layers, *self.text.layers]


def _count(images: Tensor, size: int) -> int:
    """Number of images N in ``images`` ``(B, 3N, H, W)``."""
    planes, height, width = images.shape[1:]
    if planes % 3 or (height, width) != (size, size):
        raise ConfigError(
            f"EagleBackbone: images have shape {tuple(images.shape)}, (B, 3N, {size}, {size}) "
            "expected",
            next=f"ResizeImages(height={size}, width={size}) among the transforms",
        )
    return planes // 3
