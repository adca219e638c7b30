"""Image encoder of Diffusion Policy: a ResNet and a spatial softmax."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from fluxvla_core.errors import ConfigError
from fluxvla_models.resnet import ResNet


class Keypoints(nn.Module):
    """Feature maps ``(B, C, h, w)`` to expected positions ``(B, 2 * keypoints)``, x and y of each.

    Levine et al. 2016 (arXiv 1504.00702), section 5.1; positions are in -1..1.
    """

    def __init__(self, channels: int, keypoints: int) -> None:
        super().__init__()
        self.nets = nn.Conv2d(channels, keypoints, 1)

    def forward(self, maps: Tensor) -> Tensor:
        height, width = maps.shape[-2:]
        weights = self.nets(maps).flatten(2).softmax(-1)
        return (weights @ position_grid(height, width, weights.device).to(weights)).flatten(1)


def position_grid(height: int, width: int, device: torch.device | str = "cpu") -> Tensor:
    """x and y of each place of a map, ``(height * width, 2)`` float32 in -1..1."""
    rows = torch.linspace(-1.0, 1.0, height, dtype=torch.float64, device=device)
    columns = torch.linspace(-1.0, 1.0, width, dtype=torch.float64, device=device)
    grid = torch.stack([columns.repeat(height), rows.repeat_interleave(width)], dim=1)
    return grid.float()


class KeypointEncoder(nn.Module):
    """Images ``(B, 3, H, W)`` to feature vectors ``(B, 2 * keypoints)``.

    Args:
        backbone, norm, width: see ``ResNet``.
        keypoints: how many.
        resize: ``(height, width)`` that images are resized to first, bilinear, antialiased.
        crop: ``(height, width)`` that is cut from them then: the middle, or where ``forward`` says.
    """

    def __init__(
        self,
        backbone: str = "resnet18",
        norm: str = "group",
        width: int = 64,
        keypoints: int = 32,
        resize: Sequence[int] | None = None,
        crop: Sequence[int] | None = None,
    ) -> None:
        super().__init__()
        self.resize = None if resize is None else tuple(resize)
        self.crop = None if crop is None else tuple(crop)
        self.backbone = ResNet(backbone, norm, width)
        self.pool = Keypoints(self.backbone.out_channels, keypoints)
        self.out_dim = 2 * keypoints
        self.out = nn.Linear(self.out_dim, self.out_dim)

    def forward(self, images: Tensor, places: Tensor | None = None) -> Tensor:
        """``images`` ``(B, 3, H, W)``; ``places`` ``(B, 2)`` in 0..1, of the crop's upper left
        corner between its first and its last possible row and column.

        Raises:
            ConfigError: an image is smaller than the crop.
        """
        if self.resize is not None:
            images = functional.interpolate(
                images, size=self.resize, mode="bilinear", antialias=True, align_corners=False
            )
        if self.crop is not None:
            images = cropped(images, self.crop, places)
        return functional.relu(self.out(self.pool(self.backbone(images))))


def cropped(images: Tensor, size: tuple[int, ...], places: Tensor | None) -> Tensor:
    """``(B, C, height, width)`` cut from ``(B, C, H, W)``: the middle, or by ``places``."""
    height, width = size
    spare = images.shape[-2] - height, images.shape[-1] - width
    if min(spare) < 0:
        raise ConfigError(
            f"images of {images.shape[-2]} x {images.shape[-1]} pixels are smaller than "
            f"crop_shape {height} x {width}",
            next="resize_shape or crop_shape of the model, or larger images",
        )
    if places is None:
        top, left = round(spare[0] / 2), round(spare[1] / 2)
        return images[..., top : top + height, left : left + width]
    corners = (places * (torch.tensor(spare, device=places.device) + 1)).long()
    rows = corners[:, 0, None] + torch.arange(height, device=images.device)
    columns = corners[:, 1, None] + torch.arange(width, device=images.device)
    batch = torch.arange(len(images), device=images.device)[:, None, None]
    cut = images.permute(0, 2, 3, 1)[batch, rows[:, :, None], columns[:, None, :]]
    return cut.permute(0, 3, 1, 2)
