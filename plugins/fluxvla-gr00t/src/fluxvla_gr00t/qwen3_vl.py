"""Qwen3-VL, the vision-language model of GR00T N1.7 (Cosmos-Reason2-2B): its first layers."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from transformers import Qwen3VLConfig, Qwen3VLModel

from fluxvla_core.errors import ConfigError
from fluxvla_core.models import has_values
from fluxvla_gr00t.context import Context
from fluxvla_gr00t.image_tokens import image_token_of, image_token_positions


class Qwen3VLBackbone(nn.Module):
    """Images and tokens to hidden states; the defaults are those of GR00T N1.7.

    The features are what the last layer gives, before the model's last norm, which is not in it;
    nor is the output layer over words.

    Args:
        patch_size, merge: pixels of a patch's side, and patches of a token's; 16 and 2: an image
            of 256 x 256 pixels takes 8 x 8 tokens of the prompt.
        vision_dim, vision_layers, vision_heads, vision_mlp: the vision tower.
        vision_positions: learned positions of patches, a square's.
        deepstack: layers of the vision tower whose features are added to those of the language
            model's first layers.
        text_dim, text_layers, text_heads, text_kv_heads, text_head_dim, text_mlp, vocabulary: the
            language model; ``text_layers`` is the published ``select_layer``.
        rope_theta, rope_sections: its rotary positions, in time, height and width.
        image_token: the token that stands for a part of an image, ``<|image_pad|>``.
    """

    def __init__(
        self,
        patch_size: int = 16,
        merge: int = 2,
        vision_dim: int = 1024,
        vision_layers: int = 24,
        vision_heads: int = 16,
        vision_mlp: int = 4096,
        vision_positions: int = 2304,
        deepstack: Sequence[int] = (5, 11, 17),
        text_dim: int = 2048,
        text_layers: int = 16,
        text_heads: int = 16,
        text_kv_heads: int = 8,
        text_head_dim: int = 128,
        text_mlp: int = 6144,
        vocabulary: int = 151936,
        rope_theta: float = 5e6,
        rope_sections: Sequence[int] = (24, 20, 20),
        image_token: int = 151655,
        picture_token: int | None = None,
    ) -> None:
        super().__init__()
        image_token = image_token_of("Qwen3VLBackbone", image_token, picture_token, vocabulary)
        if max(deepstack, default=0) >= vision_layers or len(deepstack) > text_layers:
            raise ConfigError(
                f"Qwen3VLBackbone: deepstack {list(deepstack)} names layers that "
                f"{vision_layers} vision_layers and {text_layers} text_layers do not have"
            )
        if 2 * sum(rope_sections) != text_head_dim:
            raise ConfigError(
                f"Qwen3VLBackbone: rope_sections {list(rope_sections)} add up to "
                f"{sum(rope_sections)}, half of text_head_dim {text_head_dim} is expected"
            )
        self.out_dim = text_dim
        self.image_token = image_token
        self.patch_size, self.merge = patch_size, merge
        self.model = Qwen3VLModel(
            Qwen3VLConfig(
                image_token_id=image_token,
                # Videos are not used; any other token will do.
                video_token_id=(image_token + 1) % vocabulary,
                attn_implementation="sdpa",
                vision_config={
                    "depth": vision_layers,
                    "hidden_size": vision_dim,
                    "intermediate_size": vision_mlp,
                    "num_heads": vision_heads,
                    "num_position_embeddings": vision_positions,
                    "out_hidden_size": text_dim,
                    "patch_size": patch_size,
                    "spatial_merge_size": merge,
                    "temporal_patch_size": _FRAMES,
                    "deepstack_visual_indexes": list(deepstack),
                },
                text_config={
                    "vocab_size": vocabulary,
                    "hidden_size": text_dim,
                    "num_hidden_layers": text_layers,
                    "num_attention_heads": text_heads,
                    "num_key_value_heads": text_kv_heads,
                    "head_dim": text_head_dim,
                    "intermediate_size": text_mlp,
                    "rms_norm_eps": 1e-6,
                    "use_cache": False,
                    "rope_parameters": {
                        "rope_type": "default",
                        "rope_theta": rope_theta,
                        "mrope_section": list(rope_sections),
                        "mrope_interleaved": True,
                    },
                },
            )
        )
        self.model.language_model.norm = nn.Identity()

    def forward(
        self, images: Tensor, lang_tokens: Tensor, lang_masks: Tensor, img_masks: Tensor | None
    ) -> Context:
        """Hidden states of the language model's last layer.

        Args:
            images: ``(B, 3N, H, W)`` normalised; H and W multiples of ``patch_size * merge``.
            lang_tokens, lang_masks: ``(B, L)`` int64 and bool, with the image tokens of N images.
            img_masks: ``(B, N)`` bool, False where a camera's image is absent; None: all there.

        Raises:
            ConfigError: images of a size that does not fit, or image tokens of another number.
        """
        side = self.patch_size * self.merge
        planes, height, width = images.shape[1:]
        if planes % 3 or height % side or width % side:
            raise ConfigError(
                f"Qwen3VLBackbone: images have shape {tuple(images.shape)}, (B, 3N, H, W) with H "
                f"and W multiples of {side} expected"
            )
        count, tokens_per_image = planes // 3, (height // side) * (width // side)
        image_mask, mask = image_token_positions(
            lang_tokens, lang_masks, img_masks, self.image_token, count, tokens_per_image
        )
        if not has_values(images) and not any(p.requires_grad for p in self.parameters()):
            # transformers finds image tokens by their values, which meta tensors do not have; for a
            # frozen model the shape is enough.
            return Context(images.new_empty((*lang_tokens.shape, self.out_dim)), mask, image_mask)
        flat = images.unflatten(1, (count, 3)).flatten(0, 1)
        patches = images_to_patches(flat, self.patch_size, self.merge)
        grid = torch.tensor([[1, height // self.patch_size, width // self.patch_size]])
        grids = grid.expand(len(flat), 3).to(images.device)
        positions, _ = self.model.get_rope_index(
            lang_tokens,
            mm_token_type_ids=image_mask.int(),
            image_grid_thw=grids,
            attention_mask=lang_masks.long(),
        )
        output = self.model(
            input_ids=lang_tokens,
            attention_mask=mask.long(),
            position_ids=positions,
            pixel_values=patches,
            image_grid_thw=grids,
            mm_token_type_ids=image_mask.int(),
            use_cache=False,
        )
        return Context(output.last_hidden_state, mask, image_mask)

    def fsdp_units(self) -> list[nn.Module]:
        """Blocks to shard one by one."""
        return [*self.model.visual.blocks, *self.model.language_model.layers]


# An image is a film of this many equal frames.
_FRAMES = 2


def images_to_patches(images: Tensor, patch: int, merge: int) -> Tensor:
    """``(M, 3, H, W)`` -> ``(M * H/patch * W/patch, 3 * 2 * patch * patch)``.

    The order is that of Qwen's image processor: images, places, patches of a place; within one
    colours, the two frames that an image is a film of, rows and columns.
    """
    many, colours, height, width = images.shape
    side = patch * merge
    cut = images.reshape(
        many, colours, height // side, merge, patch, width // side, merge, patch
    ).permute(0, 2, 5, 3, 6, 1, 4, 7)
    films = cut.unsqueeze(6).expand(*cut.shape[:6], _FRAMES, patch, patch)
    return films.reshape(-1, colours * _FRAMES * patch * patch)
