"""What GR00T N1.7 does to pictures, instructions, states and actions before the model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core import build_tokenizer_from_cfg
from fluxvla_core.data import split_images, stack_images
from fluxvla_core.errors import ConfigError
from fluxvla_core.training import Tokenizer, Transform

Picture = npt.NDArray[np.uint8]
METHODS = ("bicubic", "area")
SIDE = 32
"""Pixels of the side of a place between the words: 2 x 2 patches of 16 x 16."""
_PLACE, _START, _END = "<|image_pad|>", "<|vision_start|>", "<|vision_end|>"


class ResizeCropImages(Transform):
    """Resize every picture, cut its middle out and resize that; uint8 ``(3N, H, W)``.

    Args:
        size: side of the result; with ``area`` its shorter one.
        shortest_edge: what is resized to first; ``size`` if None.
        crop_fraction: share of height and width that is kept; 1 cuts nothing.
        method: ``bicubic``: to a square, antialiased; ``area``: the aspect is kept, by OpenCV's
            INTER_AREA, and then sides are brought to multiples of 32. Which one a published
            checkpoint was trained with is its ``use_albumentations``: ``area`` if true.
        letter_box: make pictures square with black bars first.

    Raises:
        ConfigError: an unknown ``method``, a ``size`` that is no multiple of 32, or a
            ``crop_fraction`` outside of 0..1.
    """

    def __init__(
        self,
        size: int = 256,
        shortest_edge: int | None = None,
        crop_fraction: float = 230 / 256,
        method: str = "bicubic",
        letter_box: bool = False,
    ) -> None:
        if method not in METHODS:
            raise ConfigError(
                f"ResizeCropImages: method {method!r} is not one of {', '.join(METHODS)}"
            )
        if size < SIDE or size % SIDE:
            raise ConfigError(f"ResizeCropImages: size {size} is not a multiple of {SIDE}")
        if not 0 < crop_fraction <= 1:
            raise ConfigError(
                "ResizeCropImages: crop_fraction must be above 0 and at most 1, "
                f"got {crop_fraction}"
            )
        self.size = size
        self.edge = size if shortest_edge is None else shortest_edge
        self.crop_fraction = crop_fraction
        self.method = method
        self.letter_box = letter_box

    def __call__(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        pictures = [self._one(picture) for picture in split_images(sample["images"])]
        return {**sample, "images": stack_images(pictures)}

    def _one(self, picture: Picture) -> Picture:
        if self.letter_box:
            picture = _square(picture)
        if self.method == "area":
            whole = _to_shortest(picture, self.edge)
            cut = _to_shortest(_middle(whole, self.crop_fraction, int), self.edge)
            sides = (max(SIDE, round(side / SIDE) * SIDE) for side in cut.shape[1:])
            return _bicubic(cut, *sides)
        whole = _bicubic(picture, self.edge, self.edge)
        return _bicubic(_middle(whole, self.crop_fraction, round), self.size, self.size)


class ProcessQwenPrompts(Transform):
    """Tokenise Qwen3-VL's chat with places for pictures: ``lang_tokens`` and ``lang_masks``.

    The text is ``<|im_start|>user``, for each picture ``<|vision_start|>``, its places and
    ``<|vision_end|>``, then the instruction and ``<|im_end|>``. There is one place for 32 x 32
    pixels, so this belongs behind what resizes pictures. Padding stands on the left.

    Args:
        tokenizer: a table of ``fluxvla.tokenizers``, or one already built.
        max_len: length of the result; places count.
        formalize: write the instruction in lower case and without punctuation, as in the
            published training (``formalize_language``).

    Raises:
        ConfigError: there is no instruction, or none is left; the chat is longer than ``max_len``;
            ``<|image_pad|>`` is not one token of the tokenizer, or stands in the instruction; or
            the sides of pictures are not multiples of 32.
    """

    def __init__(
        self, tokenizer: Mapping[str, Any] | Any, max_len: int = 320, formalize: bool = True
    ) -> None:
        self.tokenizer = Tokenizer.adapt(build_tokenizer_from_cfg(tokenizer))
        self.max_len = max_len
        self.formalize = formalize
        ids = list(self.tokenizer.encode(_PLACE))
        if len(ids) != 1:
            raise ConfigError(
                f"ProcessQwenPrompts: {_PLACE} is not a token of this tokenizer, it is cut into "
                f"{len(ids)}",
                cause="the tokenizer is not the one of the model that sees pictures",
            )
        self._place = int(ids[0])
        # A dataset has a handful of instructions and millions of frames.
        self._known: dict[tuple[str, int, int], tuple[Any, Any]] = {}

    def __call__(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        text = sample.get("prompt", sample.get("task_description"))
        words = text.strip() if isinstance(text, str) else ""
        if self.formalize:
            kept = (c for c in words.lower() if c.isalnum() or c.isspace() or c == "_")
            words = "".join(kept).strip()
        if not words:
            raise ConfigError(
                "ProcessQwenPrompts: there is no instruction: neither 'prompt' nor "
                f"'task_description' in the sample has words ({text!r})"
            )
        pictures = split_images(sample["images"])
        key = (words, len(pictures), _places(pictures[0]) if pictures else 0)
        if key not in self._known:
            self._known[key] = self._tokens(*key)
        tokens, mask = self._known[key]
        return {**sample, "lang_tokens": tokens.copy(), "lang_masks": mask.copy()}

    def _tokens(
        self, words: str, pictures: int, places: int
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
        seen = f"{_START}{_PLACE * places}{_END}" * pictures
        ids = list(self.tokenizer.encode(f"<|im_start|>user\n{seen}{words}<|im_end|>\n"))
        if ids.count(self._place) != pictures * places:
            raise ConfigError(
                f"ProcessQwenPrompts: the chat around the instruction {words!r} has "
                f"{ids.count(self._place)} places for pictures, {pictures} x {places} expected",
                cause=f"the instruction itself holds {_PLACE}",
            )
        if len(ids) > self.max_len:
            raise ConfigError(
                f"ProcessQwenPrompts: the instruction {words!r} has {len(ids)} tokens with "
                f"{pictures} x {places} places for pictures, max_len is {self.max_len}",
                next=f"--set <ProcessQwenPrompts>.max_len={len(ids)} (or more)",
            )
        tokens = np.full(self.max_len, int(self.tokenizer.pad_token_id or 0), np.int64)
        mask = np.zeros(self.max_len, np.bool_)
        tokens[self.max_len - len(ids) :], mask[self.max_len - len(ids) :] = ids, True
        return tokens, mask


class ListInstruction(Transform):
    """Write the instruction as a list of one, ``['lift the cup']``, into ``prompt``.

    Before what tokenises it. GR00T N1.5 was trained on instructions written so.

    Raises:
        ConfigError: there is no instruction.
    """

    keeps_images = True

    def __call__(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        text = sample.get("prompt", sample.get("task_description"))
        if not isinstance(text, str) or not text.strip():
            raise ConfigError(
                "ListInstruction: there is no instruction: neither 'prompt' nor "
                f"'task_description' is in the sample ({text!r})"
            )
        return {**sample, "prompt": str([text])}


class ClipNormalized(Transform):
    """Clip normalised ``states``, and ``actions`` where there are any, to -1..1.

    Behind ``NormalizeStatesAndActions``. GR00T N1.7 clips outliers so (``clip_outliers``).
    """

    keeps_images = True

    def __call__(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        clipped = {
            key: np.clip(sample[key], -1.0, 1.0) for key in ("states", "actions") if key in sample
        }
        return {**sample, **clipped}


def _places(picture: Picture) -> int:
    height, width = picture.shape[1:]
    if height % SIDE or width % SIDE:
        raise ConfigError(
            f"ProcessQwenPrompts: pictures have {height} x {width} pixels, sides are to be "
            f"multiples of {SIDE}",
            next="ResizeCropImages, or ResizeImages, before ProcessQwenPrompts",
        )
    return (height // SIDE) * (width // SIDE)


def _square(picture: Picture) -> Picture:
    height, width = picture.shape[1:]
    side = max(height, width)
    above, before = (side - height) // 2, (side - width) // 2
    rows, columns = (above, side - height - above), (before, side - width - before)
    return np.pad(picture, ((0, 0), rows, columns))


def _middle(picture: Picture, fraction: float, whole: Any) -> Picture:
    """The middle of ``(3, H, W)``; ``whole`` makes pixels of a share of them."""
    height, width = picture.shape[1:]
    tall, wide = (max(1, whole(side * fraction)) for side in (height, width))
    top, left = (height - tall) // 2, (width - wide) // 2
    return picture[:, top : top + tall, left : left + wide]


def _to_shortest(picture: Picture, edge: int) -> Picture:
    """``(3, H, W)`` with its shorter side ``edge`` pixels long."""
    height, width = picture.shape[1:]
    shortest = min(height, width)
    if shortest == edge:
        return picture
    import cv2

    sizes = (max(1, round(side * (edge / shortest))) for side in (width, height))
    rows = np.ascontiguousarray(picture.transpose(1, 2, 0))
    resized = cv2.resize(rows, tuple(sizes), interpolation=cv2.INTER_AREA)
    return np.asarray(resized, np.uint8).transpose(2, 0, 1)


def _bicubic(picture: Picture, height: int, width: int) -> Picture:
    """``(3, height, width)``, antialiased."""
    if picture.shape[1:] == (height, width):
        return picture
    import torch
    from torch.nn import functional

    values = torch.from_numpy(np.ascontiguousarray(picture))[None]
    made = functional.interpolate(
        values, (height, width), mode="bicubic", antialias=True, align_corners=False
    )
    return np.asarray(made[0].numpy(), np.uint8)
