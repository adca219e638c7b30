"""Transforms of camera images: resize, pad, crop, random shift, normalise.

``sample["images"]`` is a list of ``(3, H, W)`` arrays, one a camera, or one ``(3N, H, W)`` array
of N cameras of equal size. Images stay uint8 until they are normalised, and are never resized
twice.

Normalisation can be deferred to the device that computes the model: images are then transferred as
uint8 with ``image_scale``, ``(4, 3N)`` float32: for each plane what to divide by, multiply by,
subtract and divide by, in this order. By 1, or 0, these change nothing, bit for bit, so one formula
serves every normaliser, and each sample of a batch has its own numbers.
"""

from __future__ import annotations

import operator
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.frame import Sample
from fluxvla_core.contracts.training import RandomTransform, Transform
from fluxvla_core.errors import ConfigError, DataError

Image = npt.NDArray[Any]
Images = list[Image] | Image
Row = npt.NDArray[np.float32] | None
Steps = tuple[Row, Row, Row, Row]
"""Divide by, multiply by, subtract, divide by: each ``(3N,)``, or None for nothing."""
SCALE = "image_scale"
"""The sample's key of a deferred normalisation."""
INTERPOLATIONS = ("linear", "area")
PADDED_INTERPOLATIONS = ("antialias", "linear")
_OTHER_ORDER = "height, width and channels are in another order, or there is an alpha channel"
_Operation = Callable[[Any, Any], Any]
_OPERATIONS: tuple[_Operation, ...] = (
    operator.itruediv,
    operator.imul,
    operator.isub,
    operator.itruediv,
)
_NOTHING = (1, 1, 0, 1)


class ResizeImages(Transform):
    """Resize every image to ``height`` x ``width``; gives ``(3N, height, width)``, same dtype.

    Args:
        interpolation: ``linear``, or ``area``, which does not alias when it shrinks.
    """

    def __init__(self, height: int, width: int, interpolation: str = "linear") -> None:
        if height < 1 or width < 1:
            raise ConfigError(f"ResizeImages: {height} x {width} is not a size")
        if interpolation not in INTERPOLATIONS:
            raise ConfigError(
                f"ResizeImages: interpolation {interpolation!r} is not one of "
                f"{', '.join(INTERPOLATIONS)}"
            )
        self.height = height
        self.width = width
        self.interpolation = interpolation

    def __call__(self, sample: Sample) -> Sample:
        resized = [self._resize(image) for image in split_images(sample["images"])]
        return {**sample, "images": join_planes(resized)}

    def _resize(self, image: Image) -> Image:
        if image.shape[1:] == (self.height, self.width):
            return image
        import cv2

        flag = cv2.INTER_AREA if self.interpolation == "area" else cv2.INTER_LINEAR
        tall = np.ascontiguousarray(image.transpose(1, 2, 0))
        out: Image = cv2.resize(tall, (self.width, self.height), interpolation=flag)
        return out.transpose(2, 0, 1)


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
        if interpolation not in PADDED_INTERPOLATIONS:
            raise ConfigError(
                f"ResizeImagesWithPad: interpolation {interpolation!r} is not one of "
                f"{', '.join(PADDED_INTERPOLATIONS)}"
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


class CropImages(Transform):
    """Crop the same rectangle from every image; a list stays a list.

    Args:
        top, left: of the rectangle's corner, in pixels of the image as it arrives here.
        height, width: of the rectangle.

    Raises:
        DataError: an image is smaller than the rectangle asks for.
    """

    def __init__(self, top: int, left: int, height: int, width: int) -> None:
        if min(top, left) < 0 or min(height, width) < 1:
            raise ConfigError(
                f"CropImages: top {top}, left {left}, height {height}, width {width} "
                "is not a rectangle"
            )
        self.top = top
        self.left = left
        self.height = height
        self.width = width

    def __call__(self, sample: Sample) -> Sample:
        images = sample["images"]
        if isinstance(images, list):
            return {**sample, "images": [self._crop(image) for image in images]}
        return {**sample, "images": self._crop(images)}

    def _crop(self, image: Image) -> Image:
        bottom, right = self.top + self.height, self.left + self.width
        if bottom > image.shape[1] or right > image.shape[2]:
            raise DataError(
                f"CropImages: rows {self.top}:{bottom}, columns {self.left}:{right} are not in an "
                f"image of {image.shape[1]} x {image.shape[2]} pixels"
            )
        return image[:, self.top : bottom, self.left : right]


class RandomShiftImages(RandomTransform):
    """Shift each camera's image randomly by up to ``pixels`` both ways; borders are repeated.

    Source: Kostrikov et al., "Image augmentation is all you need", 2020.
    """

    training_only = True

    def __init__(self, pixels: int) -> None:
        if pixels < 0:
            raise ConfigError(f"RandomShiftImages: pixels must be at least 0, got {pixels}")
        self.pixels = pixels

    def __call__(self, sample: Sample, rng: np.random.Generator) -> Sample:
        images = sample["images"]
        shifted = [self._shift(image, rng) for image in split_images(images)]
        whole = shifted if isinstance(images, list) else np.concatenate(shifted)
        return {**sample, "images": whole}

    def _shift(self, image: npt.NDArray[Any], rng: np.random.Generator) -> npt.NDArray[Any]:
        down, right = rng.integers(-self.pixels, self.pixels + 1, size=2)
        rows = np.clip(np.arange(image.shape[1]) + down, 0, image.shape[1] - 1)
        columns = np.clip(np.arange(image.shape[2]) + right, 0, image.shape[2] - 1)
        return image[:, rows[:, None], columns]


class _Normalizer(Transform):
    """Base of transforms that normalise images plane by plane, now or on the device."""

    def __call__(self, sample: Sample) -> Sample:
        images = _float_planes(sample["images"])
        return {**sample, "images": scale_(images, self._steps(len(images) // 3))}

    def defer(self, sample: Sample) -> Sample:
        """Leave it to the device; gives ``(3N, H, W)``, uint8 if the images still are."""
        images = stack_images(sample["images"])
        if images.dtype != np.uint8:
            images = _float_planes(images)
        planes = len(images)
        return {**sample, "images": images, SCALE: as_array(self._steps(planes // 3), planes)}

    @abstractmethod
    def _steps(self, cameras: int) -> Steps:
        """What to compute with the planes of so many cameras."""


class NormalizeImages(_Normalizer):
    """Normalise by mean and std: ``(x - mean) / (std + 1e-8)``; gives ``(3N, H, W)`` float32.

    Args:
        means, stds: one group of 3, for all cameras, or one group a camera; in the image's own
            units, that is 0..255 for uint8.
        scale_to_unit_interval: divide by 255 first; means and stds are then in 0..1.

    Raises:
        ConfigError: groups that fit no number of cameras.
    """

    def __init__(
        self,
        means: Sequence[Any],
        stds: Sequence[Any],
        scale_to_unit_interval: bool = False,
    ) -> None:
        self.means = _groups(means, "means")
        self.stds = _groups(stds, "stds")
        if self.means.shape != self.stds.shape:
            raise ConfigError(
                f"NormalizeImages: {len(self.means)} groups of means, {len(self.stds)} of stds"
            )
        if (self.stds <= 0).any():
            raise ConfigError("NormalizeImages: every std must be positive")
        self.scale_to_unit_interval = scale_to_unit_interval

    def _steps(self, cameras: int) -> Steps:
        if len(self.means) not in (1, cameras):
            raise ConfigError(
                f"NormalizeImages: {len(self.means)} groups of means and stds, {cameras} cameras",
                next="give one group for all cameras, or one for each",
            )
        repeat = cameras // len(self.means)
        means, stds = (np.tile(v, (repeat, 1)).reshape(-1) for v in (self.means, self.stds))
        unit = np.full(3 * cameras, 255, np.float32) if self.scale_to_unit_interval else None
        return unit, None, means, stds + np.float32(1e-8)


class SimpleNormalizeImages(_Normalizer):
    """Normalise to -1..1: ``x / 255 * 2 - 1``; gives ``(3N, H, W)`` float32."""

    def _steps(self, cameras: int) -> Steps:
        factor, one = (np.full(3 * cameras, v, np.float32) for v in (2 / 255, 1))
        return None, factor, one, None


def split_images(images: Images) -> list[Image]:
    """Split into one ``(3, H, W)`` array a camera.

    Raises:
        DataError: an array whose channels are not a multiple of 3, or no image at all.
    """
    if not isinstance(images, list):
        if images.ndim != 3 or len(images) == 0 or len(images) % 3:
            raise DataError(
                f"images of shape {images.shape} are not (3N, height, width)",
                cause=_OTHER_ORDER,
            )
        return list(images.reshape(-1, 3, *images.shape[1:]))
    if not images:
        raise DataError("the sample has no images")
    for image in images:
        if image.ndim != 3 or len(image) != 3:
            raise DataError(
                f"an image of shape {image.shape} is not (3, height, width)",
                cause=_OTHER_ORDER,
            )
    return images


def stack_images(images: Images) -> Image:
    """Stack all cameras' images: ``(3N, H, W)``.

    Raises:
        DataError: the cameras' sizes differ.
    """
    parts = split_images(images)
    sizes = [part.shape[1:] for part in parts]
    if len(set(sizes)) > 1:
        listed = ", ".join(f"{h} x {w}" for h, w in sizes)
        raise DataError(
            f"cameras of different sizes cannot be stacked: {listed}",
            next="put ResizeImages before this transform",
        )
    return images if isinstance(images, np.ndarray) else join_planes(parts)


def join_planes(images: Sequence[Image]) -> Image:
    """Copy ``(3, H, W)`` arrays of equal size to one new, contiguous ``(3N, H, W)``.

    Decoded images are views of (H, W, 3) memory. Copying such a view plane by plane in numpy takes
    longer than decoding it; OpenCV splits it with vector instructions.
    """
    first = images[0]
    out = np.empty((3 * len(images), *first.shape[1:]), np.result_type(*images))
    if any(i.dtype != np.uint8 or i.strides[0] != 1 or min(i.strides) < 1 for i in images):
        return np.concatenate(images, out=out)
    import cv2

    for image, planes in zip(images, out.reshape(-1, *first.shape), strict=True):
        cv2.split(image.transpose(1, 2, 0), list(planes))
    return out


def stack_steps(steps: Sequence[Sample]) -> Sample:
    """The samples of one moment's observations as one, the present one last.

    ``images`` become ``(n, 3N, H, W)`` and ``states`` ``(n, D)``; a single one stays as it is.

    Raises:
        DataError: the cameras' sizes differ.
    """
    present = steps[-1]
    if len(steps) == 1:
        return present
    stacked = {
        key: np.stack([s[key] for s in steps]) for key in ("states", SCALE) if key in present
    }
    if "images" in present:
        stacked["images"] = np.stack([stack_images(s["images"]) for s in steps])
    return {**present, **stacked}


def normalized(batch: Mapping[str, Any]) -> dict[str, Any]:
    """Apply a batch's ``image_scale``: the batch without it, with normalised float32 images."""
    rest = dict(batch)
    scale = rest.pop(SCALE, None)
    if scale is not None:
        images = rest["images"].to(scale.dtype, copy=True)
        rest["images"] = scale_(images, scale.unbind(-2))
    return rest


def scale_(images: Any, rows: Sequence[Any]) -> Any:
    """Scale ``images`` ``(..., 3N, H, W)`` float32, numpy's or torch's, in place by ``rows``."""
    for operation, row in zip(_OPERATIONS, rows, strict=True):
        if row is not None:
            images = operation(images, row[..., None, None])
    return images


def as_array(steps: Steps, planes: int) -> npt.NDArray[np.float32]:
    """``steps`` as one array ``(4, planes)``, to travel with the sample."""
    rows = [
        np.full(planes, nothing, np.float32) if row is None else row
        for row, nothing in zip(steps, _NOTHING, strict=True)
    ]
    return np.stack(rows)


def _float_planes(images: Images) -> npt.NDArray[np.float32]:
    """A new, contiguous ``(3N, H, W)`` float32 array.

    Decoded images are views of (H, W, 3) memory; arithmetic by channel is ten times slower there.
    """
    return stack_images(images).astype(np.float32, order="C")


def _groups(values: Sequence[Any], what: str) -> npt.NDArray[np.float32]:
    array = np.asarray(values, np.float32)
    array = array.reshape(1, -1) if array.ndim == 1 else array
    if array.ndim != 2 or array.shape[1] != 3 or len(array) == 0:
        raise ConfigError(
            f"NormalizeImages: {what} must be 3 numbers, or 3 for each camera; "
            f"got shape {np.shape(values)}"
        )
    return array


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
