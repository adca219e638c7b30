"""Places of pictures between words."""

from __future__ import annotations

import torch
from torch import Tensor

from fluxvla_core.errors import ConfigError


def check_tokens(who: str, picture_token: int, vocabulary: int) -> None:
    """Refuse a ``picture_token`` that is not among ``vocabulary`` tokens, with a ConfigError."""
    if not 0 <= picture_token < vocabulary:
        raise ConfigError(
            f"{who}: picture_token {picture_token} is not one of the {vocabulary} tokens of the "
            "vocabulary"
        )


def seen_places(
    tokens: Tensor,
    masks: Tensor,
    img_masks: Tensor | None,
    picture_token: int,
    count: int,
    places: int,
) -> tuple[Tensor, Tensor]:
    """Where pictures stand, and what is seen: both ``(B, L)`` bool.

    Args:
        tokens, masks: ``(B, L)``.
        img_masks: ``(B, count)`` bool; the places of an absent picture are not seen.
        picture_token: what stands for a part of a picture.
        count, places: pictures of each sample, and places of each picture.

    Raises:
        ConfigError: a row has another number of places.
    """
    where = tokens == picture_token
    found = where.sum(1)
    if bool((found != count * places).any()):
        raise ConfigError(
            f"the tokens have {found.unique().tolist()} places for pictures (token "
            f"{picture_token}), {count} pictures take {count} x {places}",
            cause="the tokenizer, the number of cameras or the size of the pictures is another "
            "than the model's",
            next="make num_images of the prompt's transform that of img_keys, and use the "
            "model's own tokenizer",
        )
    seen = masks.bool()
    if img_masks is not None:
        which = ((where.cumsum(1) - 1) // places).clamp(min=0)
        seen = seen & (~where | torch.gather(img_masks.bool(), 1, which))
    return where, seen


def fill_places(words: Tensor, where: Tensor, seen: Tensor) -> Tensor:
    """``words`` ``(B, L, C)`` with ``seen`` ``(places, C)`` where ``where`` ``(B, L)`` is True."""
    return words.masked_scatter(where[..., None], seen.to(words.dtype))
