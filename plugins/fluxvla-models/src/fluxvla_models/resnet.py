"""ResNet-18 and -34 without their classifiers (He et al. 2016), under torchvision's names.

``conv1``, ``bn1``, ``layer1.0.conv1``, …, ``layer4.1.bn2``, ``layer2.0.downsample.0``, so that
weights published for torchvision's models, and policies built on them, are loaded as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from fluxvla_core.errors import ConfigError
from fluxvla_core.models import PartWeights

BLOCKS = {"resnet18": (2, 2, 2, 2), "resnet34": (3, 4, 6, 3)}
"""Blocks of the four stages."""
BATCH_NORMS = ("frozen_batch", "batch")
GROUP = 16
"""Channels in a group of the group normalisation (Chi et al. 2023, section 3)."""


def published(place: str, inside: Sequence[str], norm: str) -> PartWeights:
    """torchvision's weights at ``place``, for the networks whose names here begin with ``inside``.

    Raises:
        ConfigError: the networks have no batch normalisation, which those weights are made for.
    """
    if norm not in BATCH_NORMS:
        raise ConfigError(
            f"backbone_weights: they come with batch normalisation, and backbone_norm is {norm!r}",
            next=f"backbone_norm={' or '.join(map(repr, BATCH_NORMS))}",
        )
    # The classifier, and a counter that only training by a batch's own statistics needs.
    unread = ("fc.weight", "fc.bias", "num_batches_tracked")
    return PartWeights(place, dict.fromkeys(inside, ""), unread)


class FrozenBatchNorm2d(nn.Module):
    """Batch normalisation whose statistics, scale and shift are all constants."""

    weight: Tensor
    bias: Tensor
    running_mean: Tensor
    running_var: Tensor

    def __init__(self, channels: int, eps: float = 1e-5) -> None:
        super().__init__()
        self.eps = eps
        self.register_buffer("weight", torch.ones(channels))
        self.register_buffer("bias", torch.zeros(channels))
        self.register_buffer("running_mean", torch.zeros(channels))
        self.register_buffer("running_var", torch.ones(channels))

    def forward(self, x: Tensor) -> Tensor:
        scale = self.weight * (self.running_var + self.eps).rsqrt()
        shift = self.bias - self.running_mean * scale
        return x * scale[:, None, None] + shift[:, None, None]


class FixedBatchNorm2d(nn.BatchNorm2d):
    """Batch normalisation by the running statistics, in training too; scale and shift are trained.

    A batch's own statistics would make a loss depend on which samples share a process.
    """

    def train(self, mode: bool = True) -> FixedBatchNorm2d:
        super().train(False)
        return self


def group_norm(channels: int) -> nn.GroupNorm:
    """Group normalisation with groups of ``GROUP`` channels."""
    return nn.GroupNorm(max(1, channels // GROUP), channels)


NORMS: dict[str, Callable[[int], nn.Module]] = {
    "frozen_batch": FrozenBatchNorm2d,
    "batch": FixedBatchNorm2d,
    "group": group_norm,
}


class BasicBlock(nn.Module):
    """Two 3x3 convolutions and a skip, which is a 1x1 convolution where the size changes."""

    def __init__(
        self, channels_in: int, channels: int, stride: int, norm: Callable[[int], nn.Module]
    ) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels_in, channels, 3, stride, 1, bias=False)
        self.bn1 = norm(channels)
        self.conv2 = nn.Conv2d(channels, channels, 3, 1, 1, bias=False)
        self.bn2 = norm(channels)
        self.downsample: nn.Sequential | None = None
        if stride != 1 or channels_in != channels:
            self.downsample = nn.Sequential(
                nn.Conv2d(channels_in, channels, 1, stride, bias=False), norm(channels)
            )

    def forward(self, x: Tensor) -> Tensor:
        skip = x if self.downsample is None else self.downsample(x)
        y = functional.relu(self.bn1(self.conv1(x)))
        return functional.relu(self.bn2(self.conv2(y)) + skip)


class ResNet(nn.Module):
    """Images ``(B, 3, H, W)`` to the last stage's map ``(B, 8 * width, ceil(H/32), ceil(W/32))``.

    Args:
        name: ``resnet18`` or ``resnet34``.
        norm: ``frozen_batch``, ``batch`` (running statistics, never a batch's own) or ``group``.
        width: channels of the first stage; 64 is the published one.

    Raises:
        ConfigError: another name or norm.
    """

    def __init__(self, name: str = "resnet18", norm: str = "frozen_batch", width: int = 64) -> None:
        super().__init__()
        for what, value, known in (("backbone", name, BLOCKS), ("norm", norm, NORMS)):
            if value not in known:
                raise ConfigError(
                    f"{what} {value!r} of a residual network is not one of {', '.join(known)}"
                )
        make = NORMS[norm]
        self.conv1 = nn.Conv2d(3, width, 7, 2, 3, bias=False)
        self.bn1 = make(width)
        channels = width
        for stage, blocks in enumerate(BLOCKS[name]):
            out = width * 2**stage
            strides = [1 if stage == 0 else 2] + [1] * (blocks - 1)
            layer = nn.Sequential()
            for stride in strides:
                layer.append(BasicBlock(channels, out, stride, make))
                channels = out
            self.add_module(f"layer{stage + 1}", layer)
        self.out_channels = channels
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    @property
    def stages(self) -> list[nn.Module]:
        """The four stages, blocks to shard one by one."""
        return [self.get_submodule(f"layer{number}") for number in (1, 2, 3, 4)]

    def forward(self, images: Tensor) -> Tensor:
        x = functional.relu(self.bn1(self.conv1(images)))
        x = functional.max_pool2d(x, 3, 2, 1)
        for stage in self.stages:
            x = stage(x)
        return x
