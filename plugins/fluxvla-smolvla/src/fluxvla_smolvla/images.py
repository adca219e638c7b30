"""``SmolVLAImages``: a sample's images as SmolVLA takes them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core import Transform, build_transform_from_cfg
from fluxvla_core.data import split_images
from fluxvla_core.errors import ConfigError, DataError


class SmolVLAImages(Transform):
    """Normalise images to -1..1 and add cameras that are not there; gives ``(3N, H, W)`` float32.

    The model itself resizes images to the size of its vision tower, on its device, so that they
    travel as they are. Cameras of different sizes need ``height`` and ``width``: they are resized
    here, as the model does it, without distortion, with black on the left and on top.

    Args:
        height, width: of all images, usually 512 both; None leaves them as they are.
        empty_cameras: black images to add behind the others, with a mask of False: a model that
            was trained with more cameras sees them so.

    Raises:
        ConfigError: settings that fit no image.
        DataError: cameras of different sizes, and no ``height`` and ``width``.
    """

    def __init__(
        self, height: int | None = None, width: int | None = None, empty_cameras: int = 0
    ) -> None:
        if (height is None) != (width is None) or min(height or 1, width or 1) < 1:
            raise ConfigError(
                f"SmolVLAImages: height {height} and width {width} are not a size",
                next="give both, or none",
            )
        if empty_cameras < 0:
            raise ConfigError(f"SmolVLAImages: empty_cameras {empty_cameras} is below 0")
        self.size = None if height is None or width is None else (height, width)
        self.empty_cameras = empty_cameras
        self._normalize = build_transform_from_cfg({"type": "SimpleNormalizeImages"})

    def __call__(self, sample: dict[str, Any]) -> dict[str, Any]:
        return dict(self._normalize(self._complete(sample)))

    def defer(self, sample: dict[str, Any]) -> dict[str, Any]:
        """Leave the normalisation to the device."""
        return dict(self._normalize.defer(self._complete(sample)))

    def _complete(self, sample: dict[str, Any]) -> dict[str, Any]:
        images = [self._resize(image) for image in split_images(sample["images"])]
        sizes = {image.shape[1:] for image in images}
        if len(sizes) > 1:
            listed = ", ".join(f"{h} x {w}" for h, w in sorted(sizes))
            raise DataError(
                f"SmolVLAImages: cameras of different sizes: {listed}",
                next="--set <SmolVLAImages>.height=512 --set <SmolVLAImages>.width=512",
            )
        masks = np.asarray(sample.get("img_masks", np.ones(len(images))), np.bool_)
        images += [np.zeros_like(images[0])] * self.empty_cameras
        masks = np.concatenate([masks, np.zeros(self.empty_cameras, np.bool_)])
        return {**sample, "images": images, "img_masks": masks}

    def _resize(self, image: npt.NDArray[Any]) -> npt.NDArray[Any]:
        if self.size is None or image.shape[1:] == self.size:
            return image
        import torch

        from fluxvla_smolvla.vision import resize_with_pad

        pixels = torch.from_numpy(np.ascontiguousarray(image, np.float32))[None]
        return resize_with_pad(pixels, *self.size, fill=0.0)[0].numpy()
