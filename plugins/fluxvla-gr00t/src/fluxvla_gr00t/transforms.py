"""Preprocessing of GR00T N1.7: images, instructions, states and actions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core import build_tokenizer_from_cfg
from fluxvla_core.data import split_images, stack_images
from fluxvla_core.errors import ConfigError
from fluxvla_core.training import Tokenizer, Transform

Image = npt.NDArray[np.uint8]
METHODS = ("bicubic", "area")
SIDE = 32
"""Pixels of the side of a place between the words: 2 x 2 patches of 16 x 16."""
_IMAGE_TOKEN, _START, _END = "<|image_pad|>", "<|vision_start|>", "<|vision_end|>"


class ResizeCropImages(Transform):
    """Resize every image, cut its middle out and resize that; uint8 ``(3N, H, W)``.

    Args:
        size: side of the result; with ``area`` its shorter one.
        shortest_edge: what is resized to first; ``size`` if None.
        crop_fraction: share of height and width that is kept; 1 cuts nothing.
        method: ``bicubic``: to a square, antialiased; ``area``: the aspect is kept, by OpenCV's
            INTER_AREA, and then sides are brought to multiples of 32. Which one a published
            checkpoint was trained with is its ``use_albumentations``: ``area`` if true.
        letter_box: make images square with black bars first.

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
        images = [self._one(image) for image in split_images(sample["images"])]
        return {**sample, "images": stack_images(images)}

    def _one(self, image: Image) -> Image:
        if self.letter_box:
            image = _square(image)
        if self.method == "area":
            whole = _to_shortest(image, self.edge)
            cut = _to_shortest(_middle(whole, self.crop_fraction, int), self.edge)
            sides = (max(SIDE, round(side / SIDE) * SIDE) for side in cut.shape[1:])
            return _bicubic(cut, *sides)
        whole = _bicubic(image, self.edge, self.edge)
        return _bicubic(_middle(whole, self.crop_fraction, round), self.size, self.size)


class ProcessQwenPrompts(Transform):
    """Tokenise Qwen3-VL's chat with image tokens: ``lang_tokens`` and ``lang_masks``.

    The text is ``<|im_start|>user``, for each image ``<|vision_start|>``, its image tokens and
    ``<|vision_end|>``, then the instruction and ``<|im_end|>``. There is one image token for
    32 x 32 pixels, so this belongs behind transforms that resize. Padding is on the left.

    Args:
        tokenizer: a table of ``fluxvla.tokenizers``, or one already built.
        max_len: length of the result, image tokens included.
        formalize: write the instruction in lower case and without punctuation, as in the
            published training (``formalize_language``).

    Raises:
        ConfigError: there is no instruction, or none is left; the chat is longer than ``max_len``;
            ``<|image_pad|>`` is not one token of the tokenizer, or stands in the instruction; or
            the sides of images are not multiples of 32.
    """

    def __init__(
        self, tokenizer: Mapping[str, Any] | Any, max_len: int = 320, formalize: bool = True
    ) -> None:
        self.tokenizer = Tokenizer.adapt(build_tokenizer_from_cfg(tokenizer))
        self.max_len = max_len
        self.formalize = formalize
        ids = list(self.tokenizer.encode(_IMAGE_TOKEN))
        if len(ids) != 1:
            raise ConfigError(
                f"ProcessQwenPrompts: {_IMAGE_TOKEN} is not a token of this tokenizer, which "
                f"makes {len(ids)} of it",
                cause="the tokenizer is not the one of the vision-language model",
            )
        self._image_token = int(ids[0])
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
        images = split_images(sample["images"])
        key = (words, len(images), _tokens_per_image(images[0]) if images else 0)
        if key not in self._known:
            self._known[key] = self._tokens(*key)
        tokens, mask = self._known[key]
        return {**sample, "lang_tokens": tokens.copy(), "lang_masks": mask.copy()}

    def _tokens(
        self, instruction: str, count: int, tokens_per_image: int
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
        images = f"{_START}{_IMAGE_TOKEN * tokens_per_image}{_END}" * count
        ids = list(self.tokenizer.encode(f"<|im_start|>user\n{images}{instruction}<|im_end|>\n"))
        if ids.count(self._image_token) != count * tokens_per_image:
            raise ConfigError(
                f"ProcessQwenPrompts: the chat around the instruction {instruction[:100]!r} has "
                f"{ids.count(self._image_token)} image tokens, {count} x {tokens_per_image} "
                "expected",
                cause=f"the instruction itself holds {_IMAGE_TOKEN}",
            )
        if len(ids) > self.max_len:
            raise ConfigError(
                f"ProcessQwenPrompts: the instruction {instruction[:100]!r} has {len(ids)} tokens "
                f"with {count} x {tokens_per_image} image tokens, max_len is {self.max_len}",
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


def _tokens_per_image(image: Image) -> int:
    height, width = image.shape[1:]
    if height % SIDE or width % SIDE:
        raise ConfigError(
            f"ProcessQwenPrompts: images have {height} x {width} pixels, sides are to be "
            f"multiples of {SIDE}",
            next="ResizeCropImages, or ResizeImages, before ProcessQwenPrompts",
        )
    return (height // SIDE) * (width // SIDE)


def _square(image: Image) -> Image:
    height, width = image.shape[1:]
    side = max(height, width)
    above, before = (side - height) // 2, (side - width) // 2
    rows, columns = (above, side - height - above), (before, side - width - before)
    return np.pad(image, ((0, 0), rows, columns))


def _middle(image: Image, fraction: float, whole: Any) -> Image:
    """The middle of ``(3, H, W)``; ``whole`` makes pixels of a share of them."""
    height, width = image.shape[1:]
    tall, wide = (max(1, whole(side * fraction)) for side in (height, width))
    top, left = (height - tall) // 2, (width - wide) // 2
    return image[:, top : top + tall, left : left + wide]


def _to_shortest(image: Image, edge: int) -> Image:
    """``(3, H, W)`` with its shorter side ``edge`` pixels long."""
    height, width = image.shape[1:]
    shortest = min(height, width)
    if shortest == edge:
        return image
    import cv2

    sizes = (max(1, round(side * (edge / shortest))) for side in (width, height))
    rows = np.ascontiguousarray(image.transpose(1, 2, 0))
    resized = cv2.resize(rows, tuple(sizes), interpolation=cv2.INTER_AREA)
    return np.asarray(resized, np.uint8).transpose(2, 0, 1)


def _bicubic(image: Image, height: int, width: int) -> Image:
    """``(3, height, width)``, antialiased."""
    if image.shape[1:] == (height, width):
        return image
    import torch
    from torch.nn import functional

    values = torch.from_numpy(np.ascontiguousarray(image))[None]
    made = functional.interpolate(
        values, (height, width), mode="bicubic", antialias=True, align_corners=False
    )
    return np.asarray(made[0].numpy(), np.uint8)
