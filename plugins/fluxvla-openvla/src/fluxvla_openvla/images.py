"""Images as OpenVLA's code prepares them: resize, crop, and augmentation in training.

``sample["images"]`` is as of the core's transforms: uint8, a list of ``(3, H, W)`` or one
``(3N, H, W)``. The model takes images in -1..1 (the core's ``SimpleNormalizeImages``), which is
SigLIP's normalisation, and makes DINOv2's of them itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core import RandomTransform, Transform
from fluxvla_core.data import split_images
from fluxvla_core.errors import ConfigError

Image = npt.NDArray[np.uint8]
CROPPED = "cropped"
"""Key of a sample whose images have been cropped."""
INTERPOLATIONS = ("bicubic", "lanczos")


class ResizeOpenVLAImages(Transform):
    """Resize every image to a square without keeping its aspect, by Pillow, which antialiases.

    Args:
        size: pixels of a side.
        interpolation: ``bicubic``, as the published processor does; ``lanczos``, as OpenVLA's
            training data were resized (by TensorFlow, whose rounding differs in single levels).

    Raises:
        ConfigError: a size below 1 or an unknown interpolation.
    """

    def __init__(self, size: int = 224, interpolation: str = "bicubic") -> None:
        if size < 1 or interpolation not in INTERPOLATIONS:
            raise ConfigError(
                f"ResizeOpenVLAImages: size {size} must be at least 1, and interpolation "
                f"{interpolation!r} one of {', '.join(INTERPOLATIONS)}"
            )
        self.size = size
        self.interpolation = interpolation

    def __call__(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """The sample with images ``(3N, size, size)`` uint8."""
        resized = [self._resize(image) for image in split_images(sample["images"])]
        return {**sample, "images": np.concatenate(resized)}

    def _resize(self, image: Image) -> Image:
        if image.shape[1:] == (self.size, self.size):
            return image
        from PIL import Image as Pillow

        how = Pillow.Resampling[self.interpolation.upper()]
        whole = Pillow.fromarray(np.ascontiguousarray(image.transpose(1, 2, 0)))
        out = np.asarray(whole.resize((self.size, self.size), how))
        return np.ascontiguousarray(out.transpose(2, 0, 1))


class RandomCropOpenVLAImages(RandomTransform):
    """Cut out a square of ``area`` of the image at random and resize it back.

    Source: OpenVLA's fine-tuning, which takes 0.9. Acting, ``CenterCropOpenVLAImages`` cuts out the
    middle; it comes after this one in the list and leaves alone what has been cropped.

    Args:
        area: share of the image's area.
    """

    training_only = True

    def __init__(self, area: float = 0.9) -> None:
        self.side = _side(area, type(self).__name__)

    def __call__(self, sample: Mapping[str, Any], rng: np.random.Generator) -> dict[str, Any]:
        """The sample with images of the same size, cropped at one place each."""
        cropped = []
        for image in split_images(sample["images"]):
            top, left = rng.uniform(0.0, 1.0 - self.side, 2)
            cropped.append(crop_and_resize(image, float(top), float(left), self.side))
        return {**sample, "images": np.concatenate(cropped), CROPPED: True}


class CenterCropOpenVLAImages(Transform):
    """Cut out the middle ``area`` of the image and resize it back, unless it has been cropped.

    Args:
        area: share of the image's area, as in training.
    """

    def __init__(self, area: float = 0.9) -> None:
        self.side = _side(area, type(self).__name__)

    def __call__(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """The sample with images of the same size."""
        if CROPPED in sample:
            return {key: value for key, value in sample.items() if key != CROPPED}
        begin = (1.0 - self.side) / 2
        images = split_images(sample["images"])
        cropped = [crop_and_resize(image, begin, begin, self.side) for image in images]
        return {**sample, "images": np.concatenate(cropped)}


class JitterOpenVLAColors(RandomTransform):
    """Change brightness, contrast, saturation and hue at random, each image by itself.

    Source: OpenVLA's fine-tuning, whose values are the defaults; the operations are TensorFlow's.

    Args:
        brightness: up to so much is added, of 1.
        contrast, saturation: factors between 1 - this and 1 + this.
        hue: up to so much of the circle of colours is added.
    """

    training_only = True

    def __init__(
        self,
        brightness: float = 0.2,
        contrast: float = 0.2,
        saturation: float = 0.2,
        hue: float = 0.05,
    ) -> None:
        if min(brightness, contrast, saturation, hue) < 0 or max(contrast, saturation) >= 1:
            raise ConfigError(
                "JitterOpenVLAColors: brightness, contrast, saturation and hue must be at least 0, "
                f"contrast and saturation below 1; got {brightness}, {contrast}, {saturation}, "
                f"{hue}"
            )
        self.brightness, self.contrast = brightness, contrast
        self.saturation, self.hue = saturation, hue

    def __call__(self, sample: Mapping[str, Any], rng: np.random.Generator) -> dict[str, Any]:
        """The sample with changed images, uint8."""
        changed = [self._jitter(image, rng) for image in split_images(sample["images"])]
        return {**sample, "images": np.concatenate(changed)}

    def _jitter(self, image: Image, rng: np.random.Generator) -> Image:
        limits = (self.brightness, self.contrast, self.saturation, self.hue)
        added, contrast, saturation, hue = (float(rng.uniform(-limit, limit)) for limit in limits)
        pixels = np.clip(image.astype(np.float32) / 255 + added, 0.0, 1.0)
        mean = pixels.mean((1, 2), keepdims=True)
        pixels = np.clip((pixels - mean) * (1 + contrast) + mean, 0.0, 1.0)
        return to_bytes(_recolored(pixels, 1 + saturation, hue))


def crop_and_resize(image: Image, top: float, left: float, side: float) -> Image:
    """Cut out a rectangle and resize it to the image's size, linearly and without antialiasing.

    As TensorFlow's ``crop_and_resize``: the rectangle's first and last samples lie on its borders.

    Args:
        image: ``(3, H, W)`` uint8.
        top, left, side: of the rectangle, as shares of the image.
    """
    height, width = image.shape[1:]
    pixels = image.astype(np.float32) / 255
    rows, down = _between(top, side, height)
    columns, right = _between(left, side, width)
    down, right = down[:, None], right[None, :]
    upper, lower = pixels[:, rows], pixels[:, np.minimum(rows + 1, height - 1)]
    after = np.minimum(columns + 1, width - 1)
    first = upper[:, :, columns] * (1 - right) + upper[:, :, after] * right
    second = lower[:, :, columns] * (1 - right) + lower[:, :, after] * right
    return to_bytes(first * (1 - down) + second * down)


def to_bytes(pixels: npt.NDArray[np.float32]) -> Image:
    """0..1 to 0..255 as TensorFlow's ``convert_image_dtype``: times 255.5, cut off."""
    return (np.clip(pixels, 0.0, 1.0) * np.float32(255.5)).astype(np.uint8)


def _between(
    begin: float, side: float, length: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float32]]:
    """For each sample along one dimension: the pixel before it, and how far behind that it is."""
    places = begin * (length - 1) + np.arange(length) * side
    before = np.floor(places).astype(np.int64)
    return before, (places - before).astype(np.float32)


def _side(area: float, who: str) -> float:
    if not 0 < area <= 1:
        raise ConfigError(f"{who}: area must be above 0 and at most 1, got {area}")
    return math.sqrt(area)


def _recolored(
    pixels: npt.NDArray[np.float32], saturation: float, hue: float
) -> npt.NDArray[np.float32]:
    """``(3, H, W)`` in 0..1 with its saturation multiplied and its hue shifted (as HSV)."""
    value, low = pixels.max(0), pixels.min(0)
    spread = value - low
    safe = np.where(spread == 0, 1, spread)
    red, green, blue = pixels
    sixth = np.select(
        [value == red, value == green],
        [(green - blue) / safe % 6, (blue - red) / safe + 2],
        (red - green) / safe + 4,
    )
    sixth = (sixth + 6 * hue) % 6
    share = spread / np.where(value == 0, 1, value)
    share = np.clip(share * saturation, 0.0, 1.0)
    planes = []
    for centre in (0.0, 2.0, 4.0):
        distance = np.abs(sixth - centre)
        distance = np.minimum(distance, 6 - distance)
        # A colour is at its full value up to one sixth away from its hue, and least from two on.
        planes.append(value * (1 - share * np.clip(distance - 1, 0.0, 1.0)))
    return np.stack(planes).astype(np.float32)
