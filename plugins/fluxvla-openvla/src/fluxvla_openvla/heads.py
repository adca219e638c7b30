"""Action heads and projectors of OpenVLA-OFT; modules are named as in its published files.

Source: Kim, Finn, Liang, "Fine-Tuning Vision-Language-Action Models" (2025).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

_BLOCKS = 2


class ResidualBlock(nn.Module):
    """Norm, one layer and a ReLU, added to the input."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.ffn = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.ReLU())

    def forward(self, x: Tensor) -> Tensor:
        """``(..., width)``, same shape."""
        return x + self.ffn(x)


class MLPResNet(nn.Module):
    """Two residual blocks between an input and an output layer."""

    def __init__(self, input_width: int, width: int, output_width: int) -> None:
        super().__init__()
        self.layer_norm1 = nn.LayerNorm(input_width)
        self.fc1 = nn.Linear(input_width, width)
        self.mlp_resnet_blocks = nn.ModuleList(ResidualBlock(width) for _ in range(_BLOCKS))
        self.layer_norm2 = nn.LayerNorm(width)
        self.fc2 = nn.Linear(width, output_width)

    def forward(self, x: Tensor) -> Tensor:
        """``(..., input_width)`` -> ``(..., output_width)``."""
        x = functional.relu(self.fc1(self.layer_norm1(x)))
        for block in self.mlp_resnet_blocks:
            x = block(x)
        return self.fc2(self.layer_norm2(x))


class L1RegressionHead(nn.Module):
    """The states of an action's tokens, side by side, to the action."""

    def __init__(self, width: int, action_dim: int) -> None:
        super().__init__()
        self.model = MLPResNet(width * action_dim, width, action_dim)

    def forward(self, states: Tensor) -> Tensor:
        """``(B, T, action_dim * width)`` -> ``(B, T, action_dim)``."""
        return self.model(states)


class NoisePredictor(nn.Module):
    """The network of ``DiffusionHead``, which is one level deeper in its published file."""

    def __init__(self, width: int, action_dim: int) -> None:
        super().__init__()
        self.mlp_resnet = MLPResNet(width * action_dim, width, action_dim)

    def forward(self, states: Tensor) -> Tensor:
        """``(B, T, action_dim * width)`` -> ``(B, T, action_dim)``."""
        return self.mlp_resnet(states)


class DiffusionHead(nn.Module):
    """The states of noised actions' tokens to the noise in them."""

    def __init__(self, width: int, action_dim: int) -> None:
        super().__init__()
        self.noise_predictor = NoisePredictor(width, action_dim)

    def forward(self, states: Tensor) -> Tensor:
        """``(B, T, action_dim * width)`` -> noise ``(B, T, action_dim)``."""
        return self.noise_predictor(states)


class StateProjector(nn.Module):
    """Two layers to one token: of the robot's state, or of one noised number of an action."""

    def __init__(self, input_width: int, width: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(input_width, width)
        self.fc2 = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """``(..., input_width)`` -> ``(..., width)``."""
        return self.fc2(functional.gelu(self.fc1(x)))


def step_embedding(steps: Tensor, width: int) -> Tensor:
    """Sines, then cosines, of diffusion steps ``(B,)`` -> ``(B, width)`` float32."""
    half = width // 2
    exponents = torch.arange(half, device=steps.device) * (-math.log(10000) / (half - 1))
    angles = steps.float()[:, None] * exponents.exp()
    return torch.cat([angles.sin(), angles.cos()], -1)


def kept_share(num_steps: int) -> Tensor:
    """How much of the clean actions' variance is left at each step: ``(num_steps,)`` float32.

    The cosine schedule of Nichol and Dhariwal, "Improved denoising diffusion" (2021). It is no
    buffer of the model: one that is cast to bfloat16 would round it.
    """

    def level(t: float) -> float:
        return math.cos((t + 0.008) / 1.008 * math.pi / 2) ** 2

    betas = [
        min(1 - level((i + 1) / num_steps) / level(i / num_steps), 0.999) for i in range(num_steps)
    ]
    return (1 - torch.tensor(betas, dtype=torch.float32)).cumprod(0)


def denoise(noised: Tensor, noise: Tensor, now: Tensor, after: Tensor) -> Tensor:
    """One deterministic step of DDIM (Song et al., 2021), as OpenVLA-OFT runs it.

    Args:
        noised: ``(B, T, D)``; noise: what was predicted in it.
        now, after: scalars, the share that is kept at this step and at the next.

    Returns:
        ``(B, T, D)``. The clean actions in between are clipped to -1..1; the noise is not changed
        to match.
    """
    clean = ((noised - (1 - now).sqrt() * noise) / now.sqrt()).clamp(-1.0, 1.0)
    return after.sqrt() * clean + (1 - after).sqrt() * noise
