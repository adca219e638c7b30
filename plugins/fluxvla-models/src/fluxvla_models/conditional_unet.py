"""A FiLM-conditioned 1D U-Net over time (Chi et al. 2023, Diffusion Policy).

Parameters are named as in LeRobot's implementation of Diffusion Policy.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from fluxvla_core.errors import ConfigError


class StepEmbedding(nn.Module):
    """Sines and cosines of a diffusion step: ``(B,)`` -> ``(B, width)``."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.width = width

    def forward(self, timesteps: Tensor) -> Tensor:
        half = self.width // 2
        # In float32 at least, and in float64 in a model that is.
        dtype = torch.promote_types(torch.float32, torch.get_default_dtype())
        index = torch.arange(half, device=timesteps.device, dtype=dtype)
        angles = timesteps[:, None] * torch.exp(index * -(math.log(10000.0) / (half - 1)))
        return torch.cat([angles.sin(), angles.cos()], dim=-1)


class ConvBlock(nn.Module):
    """Convolution over time, group normalisation, Mish."""

    def __init__(self, channels_in: int, channels: int, kernel: int, groups: int) -> None:
        super().__init__()
        self.block = nn.Sequential(
            nn.Conv1d(channels_in, channels, kernel, padding=kernel // 2),
            nn.GroupNorm(groups, channels),
            nn.Mish(),
        )

    def forward(self, x: Tensor) -> Tensor:
        return self.block(x)


class ConditionedBlock(nn.Module):
    """Two convolutions with a skip; the condition shifts, and may scale, between them (FiLM)."""

    def __init__(
        self,
        channels_in: int,
        channels: int,
        condition: int,
        kernel: int,
        groups: int,
        scaled: bool,
    ) -> None:
        super().__init__()
        self.scaled = scaled
        self.conv1 = ConvBlock(channels_in, channels, kernel, groups)
        self.cond_encoder = nn.Sequential(
            nn.Mish(), nn.Linear(condition, 2 * channels if scaled else channels)
        )
        self.conv2 = ConvBlock(channels, channels, kernel, groups)
        self.residual_conv: nn.Module = nn.Identity()
        if channels_in != channels:
            self.residual_conv = nn.Conv1d(channels_in, channels, 1)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """``(B, C, T)`` and ``(B, condition)`` -> ``(B, channels, T)``."""
        change = self.cond_encoder(condition)[..., None]
        y = self.conv1(x)
        if self.scaled:
            scale, shift = change.chunk(2, dim=1)
            y = scale * y + shift
        else:
            y = y + change
        return self.conv2(y) + self.residual_conv(x)


class ConditionalUNet(nn.Module):
    """A noisy chunk, the step and the condition to a prediction of the chunk's size.

    Args:
        action_dim: width of an action; condition_dim: of what is known.
        down_dims: channels of each level; time is halved between levels.
        kernel_size, n_groups: of the convolutions and their normalisation.
        step_dim: width of the step's embedding.
        use_film_scale: the condition scales as well as shifts.

    Raises:
        ConfigError: ``n_groups`` does not divide the channels.
    """

    def __init__(
        self,
        action_dim: int,
        condition_dim: int,
        down_dims: Sequence[int] = (512, 1024, 2048),
        kernel_size: int = 5,
        n_groups: int = 8,
        step_dim: int = 128,
        use_film_scale: bool = True,
    ) -> None:
        super().__init__()
        widths = list(down_dims)
        if not widths or any(width % n_groups for width in widths):
            raise ConfigError(f"down_dims {tuple(widths)} must be multiples of n_groups {n_groups}")
        self.diffusion_step_encoder = nn.Sequential(
            StepEmbedding(step_dim),
            nn.Linear(step_dim, 4 * step_dim),
            nn.Mish(),
            nn.Linear(4 * step_dim, step_dim),
        )
        more = (step_dim + condition_dim, kernel_size, n_groups, use_film_scale)
        self.down_modules = nn.ModuleList()
        for level, (before, after) in enumerate(zip([action_dim, *widths], widths, strict=False)):
            last = level == len(widths) - 1
            self.down_modules.append(
                nn.ModuleList(
                    [
                        ConditionedBlock(before, after, *more),
                        ConditionedBlock(after, after, *more),
                        nn.Identity() if last else nn.Conv1d(after, after, 3, 2, 1),
                    ]
                )
            )
        deepest = widths[-1]
        self.mid_modules = nn.ModuleList(
            ConditionedBlock(deepest, deepest, *more) for _ in range(2)
        )
        self.up_modules = nn.ModuleList(
            nn.ModuleList(
                [
                    ConditionedBlock(2 * before, after, *more),
                    ConditionedBlock(after, after, *more),
                    nn.ConvTranspose1d(after, after, 4, 2, 1),
                ]
            )
            for before, after in zip(widths[:0:-1], widths[-2::-1], strict=True)
        )
        self.final_conv = nn.Sequential(
            # Eight groups here, whatever n_groups is, as in the published networks.
            ConvBlock(widths[0], widths[0], kernel_size, 8),
            nn.Conv1d(widths[0], action_dim, 1),
        )

    def forward(self, x: Tensor, timesteps: Tensor, condition: Tensor) -> Tensor:
        """``(B, T, D)``, steps ``(B,)`` and condition ``(B, C)`` -> ``(B, T, D)``."""
        return self.at_step(x, self.diffusion_step_encoder(timesteps), condition)

    def at_step(self, x: Tensor, step: Tensor, condition: Tensor) -> Tensor:
        """As ``forward``, for steps that are embedded already, ``(B, step_dim)``."""
        known = torch.cat([step, condition], dim=-1)
        y = x.transpose(1, 2)
        skips: list[Tensor] = []
        for first, second, shrink in self.down_modules:
            y = second(first(y, known), known)
            skips.append(y)
            y = shrink(y)
        for block in self.mid_modules:
            y = block(y, known)
        for first, second, grow in self.up_modules:
            y = torch.cat([y, skips.pop()], dim=1)
            y = grow(second(first(y, known), known))
        return self.final_conv(y).transpose(1, 2)

    def fsdp_units(self) -> list[nn.Module]:
        """Blocks to shard one by one."""
        levels = [*self.down_modules, *self.up_modules]
        return [block for level in levels for block in list(level)[:2]] + list(self.mid_modules)
