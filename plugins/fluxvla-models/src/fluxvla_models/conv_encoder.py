"""A small convolutional image encoder that keeps track of where things are."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from fluxvla_core.errors import ConfigError

GROUPS = 8
"""Channels are normalised in groups: unlike a batch's, their statistics do not depend on which
samples share a step, so that a result is the same on one process and on many."""


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions with group normalisation and a skip (He et al. 2016, figure 5)."""

    def __init__(self, channels_in: int, channels_out: int, stride: int = 1) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels_in, channels_out, 3, stride, 1, bias=False)
        self.norm1 = nn.GroupNorm(GROUPS, channels_out)
        self.conv2 = nn.Conv2d(channels_out, channels_out, 3, 1, 1, bias=False)
        self.norm2 = nn.GroupNorm(GROUPS, channels_out)
        self.skip: nn.Module = nn.Identity()
        if stride != 1 or channels_in != channels_out:
            self.skip = nn.Conv2d(channels_in, channels_out, 1, stride, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        y = functional.relu(self.norm1(self.conv1(x)))
        return functional.relu(self.norm2(self.conv2(y)) + self.skip(x))


class SpatialSoftmax(nn.Module):
    """Each feature map's expected position: ``(B, C, h, w)`` -> ``(B, 2 * keypoints)`` in -1..1.

    Positions below a pixel for the price of one 1x1 convolution (Levine et al. 2016, section 5.1).
    """

    def __init__(self, channels: int, keypoints: int) -> None:
        super().__init__()
        self.to_maps = nn.Conv2d(channels, keypoints, 1)

    def forward(self, x: Tensor) -> Tensor:
        height, width = x.shape[-2:]
        weights = self.to_maps(x).flatten(2).softmax(-1)
        rows = torch.linspace(-1, 1, height, device=x.device, dtype=x.dtype)
        columns = torch.linspace(-1, 1, width, device=x.device, dtype=x.dtype)
        grid = torch.stack(
            [columns.repeat(height), rows.repeat_interleave(width)], dim=1
        )  # (h * w, 2)
        return (weights @ grid).flatten(1)


class ConvEncoder(nn.Module):
    """Images to a feature vector: patches, three residual stages, keypoints, a coarse map.

    Args:
        image_size: ``(height, width)`` of each image, multiples of 16.
        channels: widths of the three stages (strides 4, 8 and 16), multiples of 8.
        keypoints: spatial-softmax keypoints of the stages at stride 4 and at stride 8.
        map_channels: channels of the last stage's map, flattened and joined to the keypoints.
        num_cameras: images per sample; each is encoded by the same weights.
    """

    def __init__(
        self,
        image_size: Sequence[int] = (64, 128),
        channels: Sequence[int] = (32, 64, 96),
        keypoints: int = 32,
        map_channels: int = 16,
        num_cameras: int = 1,
    ) -> None:
        super().__init__()
        height, width = image_size
        if height % 16 or width % 16:
            raise ValueError(f"image_size must be multiples of 16, got {height}x{width}")
        first, second, third = channels
        self.num_cameras = num_cameras
        self.stem = nn.Sequential(
            nn.Conv2d(3, first, 4, 4, bias=False), nn.GroupNorm(GROUPS, first), nn.ReLU()
        )
        self.stage1 = ResidualBlock(first, first)
        self.stage2 = ResidualBlock(first, second, 2)
        self.stage3 = ResidualBlock(second, third, 2)
        self.fine = SpatialSoftmax(first, keypoints)
        self.coarse = SpatialSoftmax(second, keypoints)
        self.reduce = nn.Conv2d(third, map_channels, 1)
        per_camera = 4 * keypoints + map_channels * (height // 16) * (width // 16)
        self.out_dim = num_cameras * per_camera

    def forward(self, images: Tensor) -> Tensor:
        """``(B, 3 * num_cameras, H, W)`` float, about -1..1 -> ``(B, out_dim)``."""
        batch, stacked, height, width = images.shape
        if stacked != 3 * self.num_cameras:
            raise ConfigError(
                f"ConvEncoder: num_cameras is {self.num_cameras}, the batch has {stacked} image "
                f"channels ({stacked // 3} cameras)",
                next="set num_cameras to the number of the dataset's img_keys",
            )
        x = images.reshape(batch * self.num_cameras, 3, height, width)
        # oneDNN's convolutions are up to twice as fast on this layout.
        x = x.contiguous(memory_format=torch.channels_last)
        fine = self.stage1(self.stem(x))
        coarse = self.stage2(fine)
        last = self.reduce(self.stage3(coarse))
        features = torch.cat([self.fine(fine), self.coarse(coarse), last.flatten(1)], dim=1)
        return features.reshape(batch, self.out_dim)

    def fsdp_units(self) -> list[nn.Module]:
        """Blocks to shard one by one."""
        return [self.stage1, self.stage2, self.stage3]
