"""Image tokens of a prompt: their positions, the attention mask, and the features put there."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from fluxvla_core.errors import ConfigError


def image_token_of(who: str, image_token: int, picture_token: int | None, vocabulary: int) -> int:
    """The token that stands for a part of an image; ``picture_token`` is its deprecated name.

    Raises:
        ConfigError: it is not among ``vocabulary`` tokens.
    """
    if picture_token is not None:
        message = f"{who}: picture_token is deprecated, use image_token"
        warnings.warn(message, DeprecationWarning, stacklevel=3)
        image_token = picture_token
    if not 0 <= image_token < vocabulary:
        raise ConfigError(
            f"{who}: image_token {image_token} is not one of the {vocabulary} tokens of the "
            "vocabulary"
        )
    return image_token


def image_token_positions(
    tokens: Tensor,
    masks: Tensor,
    img_masks: Tensor | None,
    image_token: int,
    count: int,
    tokens_per_image: int,
) -> tuple[Tensor, Tensor]:
    """Positions of image tokens, and the attention mask: both ``(B, L)`` bool.

    Args:
        tokens, masks: ``(B, L)``.
        img_masks: ``(B, count)`` bool; the tokens of an absent image are masked.
        image_token: the token that stands for a part of an image.
        count, tokens_per_image: images of each sample, and tokens of each image.

    Raises:
        ConfigError: a row has another number of image tokens.
    """
    positions = tokens == image_token
    counts = positions.sum(1)
    if bool((counts != count * tokens_per_image).any()):
        raise ConfigError(
            f"the prompts have {counts.unique().tolist()} image tokens (token {image_token}), "
            f"{count} images take {count} x {tokens_per_image}",
            cause="the tokenizer, the number of cameras or the size of the images is another "
            "than the model's",
            next="make num_images of the prompt's transform that of img_keys, and use the "
            "model's own tokenizer",
        )
    mask = masks.bool()
    if img_masks is not None:
        image = ((positions.cumsum(1) - 1) // tokens_per_image).clamp(min=0)
        mask = mask & (~positions | torch.gather(img_masks.bool(), 1, image))
    return positions, mask


def merge_image_features(embeddings: Tensor, positions: Tensor, features: Tensor) -> Tensor:
    """Token ``embeddings`` ``(B, L, C)``, replaced by image features at the image tokens.

    Args:
        positions: ``(B, L)`` bool, True at image tokens.
        features: ``(image tokens of the batch, C)``, in their order.
    """
    return embeddings.masked_scatter(positions[..., None], features.to(embeddings.dtype))
