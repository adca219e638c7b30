"""``ResizeImagesWithPad``: images to one size without distortion, the rest filled up."""

from __future__ import annotations

from typing import Any

import numpy as np

from fluxvla_core.contracts.frame import Sample
from fluxvla_core.contracts.training import Transform
from fluxvla_core.data.transforms.images import Image, split_images
from fluxvla_core.errors import ConfigError, DataError

INTERPOLATIONS = ("antialias", "linear")


class ResizeImagesWithPad(Transform):
    """Fit every image into ``height`` x ``width``, its aspect kept; gives ``(3N, height, width)``.

    The image is as large as fits, in the middle, its size rounded down; what remains is filled with
    ``pad_value``, the odd row or column below and to the right. An image that has the size already
    is left as it is.

    Args:
        height, width: of the result, in pixels.
        interpolation: ``antialias``: Pillow's bilinear filter, uint8 in and out, the bytes of
            openpi's ``resize_with_pad``; ``linear``: bilinear between the four nearest pixels, not
            rounded, float32 out, as LeRobot resizes for PI0, PI0.5 and X-VLA.
        pad_value: of 0..255.

    Raises:
        ConfigError: no size, an unknown interpolation, or a value that is no byte.
        DataError: ``antialias`` gets images that are not uint8.
    """

    def __init__(
        self, height: int, width: int, interpolation: str = "antialias", pad_value: int = 0
    ) -> None:
        if height < 1 or width < 1:
            raise ConfigError(f"ResizeImagesWithPad: {height} x {width} is not a size")
        if interpolation not in INTERPOLATIONS:
            raise ConfigError(
                f"ResizeImagesWithPad: interpolation {interpolation!r} is not one of "
                f"{', '.join(INTERPOLATIONS)}"
            )
        if not 0 <= pad_value <= 255:
            raise ConfigError(f"ResizeImagesWithPad: pad_value {pad_value} is not in 0..255")
        self.height = height
        self.width = width
        self.interpolation = interpolation
        self.pad_value = pad_value

    def __call__(self, sample: Sample) -> Sample:
        fitted = [self._fit(image) for image in split_images(sample["images"])]
        return {**sample, "images": np.concatenate(fitted)}

    def _fit(self, image: Image) -> Image:
        rows, columns = image.shape[1:]
        if (rows, columns) == (self.height, self.width):
            return image
        ratio = max(columns / self.width, rows / self.height)
        height, width = int(rows / ratio), int(columns / ratio)
        if min(height, width) < 1:
            raise DataError(
                f"an image of {rows} x {columns} pixels has no pixel left in "
                f"{self.height} x {self.width}"
            )
        small = self._resized(np.ascontiguousarray(image.transpose(1, 2, 0)), height, width)
        out = np.full((3, self.height, self.width), self.pad_value, small.dtype)
        top, left = (self.height - height) // 2, (self.width - width) // 2
        out[:, top : top + height, left : left + width] = small.transpose(2, 0, 1)
        return out

    def _resized(self, image: Image, height: int, width: int) -> Image:
        """``(H, W, 3)`` resized to ``(height, width, 3)``."""
        if self.interpolation == "linear":
            return _stretched(_stretched(image.astype(np.float32), height, 0), width, 1)
        if image.dtype != np.uint8:
            raise DataError(
                f"ResizeImagesWithPad: interpolation 'antialias' takes uint8 images, "
                f"got {image.dtype}",
                next="put it before the normalisation of images, or use interpolation='linear'",
            )
        pillow: Any = _pillow()
        return np.asarray(
            pillow.fromarray(image).resize((width, height), resample=pillow.Resampling.BILINEAR)
        )


def _stretched(image: Image, size: int, axis: int) -> Image:
    """``image`` float32 with ``size`` pixels along ``axis``, each between its two neighbours."""
    have = image.shape[axis]
    # As torch has it: a float32 scale, and one rounding of the place. Otherwise shares differ by
    # up to 4e-6 from LeRobot's.
    scale = float(np.float32(have / size))
    places = ((np.arange(size) + 0.5) * scale - 0.5).astype(np.float32)
    places = np.clip(places, 0, have - 1)
    before = places.astype(np.int64)
    after = np.minimum(before + 1, have - 1)
    share = (places - before.astype(np.float32)).reshape((-1, 1) if axis else (-1, 1, 1))
    low, high = image.take(before, axis), image.take(after, axis)
    out: Image = low * (1 - share) + high * share
    return out


def _pillow() -> Any:
    try:
        from PIL import Image as pillow
    except ImportError as error:
        raise ConfigError(
            "ResizeImagesWithPad needs Pillow for interpolation 'antialias'",
            next="pip install 'fluxvla-core[data]', or use interpolation='linear'",
        ) from error
    return pillow
