"""The vision tower and the connector: images to tokens of the language model.

SigLIP (Zhai et al. 2023) on whole images, then pixel shuffle: a square of neighbouring patches
becomes one wide vector, which a linear layer brings to the language model's width (Marafioti et
al. 2025, SmolVLM, arXiv 2504.05299).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from fluxvla_smolvla.sizes import VisionSize


class VisionAttention(nn.Module):
    """Attention between all patches of an image."""

    def __init__(self, size: VisionSize) -> None:
        super().__init__()
        self.heads = size.heads
        width = size.hidden_size
        self.q_proj = nn.Linear(width, width)
        self.k_proj = nn.Linear(width, width)
        self.v_proj = nn.Linear(width, width)
        self.out_proj = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """``(B, patches, width)`` -> the same shape."""
        query, key, value = (
            layer(x).unflatten(-1, (self.heads, -1)).transpose(1, 2)
            for layer in (self.q_proj, self.k_proj, self.v_proj)
        )
        mixed = functional.scaled_dot_product_attention(query, key, value)
        return self.out_proj(mixed.transpose(1, 2).flatten(2))


class VisionMLP(nn.Module):
    """Two linear layers with a GELU (its tanh form) between them."""

    def __init__(self, size: VisionSize) -> None:
        super().__init__()
        self.fc1 = nn.Linear(size.hidden_size, size.intermediate_size)
        self.fc2 = nn.Linear(size.intermediate_size, size.hidden_size)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(functional.gelu(self.fc1(x), approximate="tanh"))


class VisionLayer(nn.Module):
    """A pre-norm transformer layer."""

    def __init__(self, size: VisionSize) -> None:
        super().__init__()
        self.layer_norm1 = nn.LayerNorm(size.hidden_size, eps=size.layer_norm_eps)
        self.self_attn = VisionAttention(size)
        self.layer_norm2 = nn.LayerNorm(size.hidden_size, eps=size.layer_norm_eps)
        self.mlp = VisionMLP(size)

    def forward(self, x: Tensor) -> Tensor:
        """``(B, patches, width)`` -> the same shape."""
        x = x + self.self_attn(self.layer_norm1(x))
        return x + self.mlp(self.layer_norm2(x))


class VisionTower(nn.Module):
    """Images ``(B, 3, H, W)`` in -1..1 -> ``(B, patches, width)``."""

    def __init__(self, size: VisionSize) -> None:
        super().__init__()
        self.side = size.side
        self.patch_embedding = nn.Conv2d(3, size.hidden_size, size.patch_size, size.patch_size)
        self.position_embedding = nn.Embedding(size.side**2, size.hidden_size)
        self.layers = nn.ModuleList(VisionLayer(size) for _ in range(size.layers))
        self.post_layernorm = nn.LayerNorm(size.hidden_size, eps=size.layer_norm_eps)

    def forward(self, pixels: Tensor) -> Tensor:
        patches = self.patch_embedding(pixels)
        x = patches.flatten(2).transpose(1, 2) + self.position_embedding(
            self._positions(patches.shape[2], patches.shape[3], pixels.device)
        )
        for layer in self.layers:
            x = layer(x)
        return self.post_layernorm(x)

    def _positions(self, rows: int, columns: int, device: torch.device) -> Tensor:
        """Which learned position each patch has: the nearest before it on the trained grid."""
        down = torch.arange(rows, device=device) * self.side // rows
        right = torch.arange(columns, device=device) * self.side // columns
        return (down[:, None] * self.side + right).flatten()


class Connector(nn.Module):
    """Patches ``(B, patches, width)`` to ``(B, patches / scale_factor^2, out)`` tokens."""

    def __init__(self, size: VisionSize, out: int) -> None:
        super().__init__()
        self.scale = size.scale_factor
        self.proj = nn.Linear(size.hidden_size * self.scale**2, out, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        side = round(x.shape[1] ** 0.5)
        blocks = x.unflatten(1, (side // self.scale, self.scale, side // self.scale, self.scale))
        # Rows of blocks, columns of blocks, then what is in a block: row, column, width.
        return self.proj(blocks.transpose(2, 3).flatten(3).flatten(1, 2))


def resize_with_pad(images: Tensor, height: int, width: int, fill: float) -> Tensor:
    """``(B, C, H, W)`` float images at ``height`` x ``width`` without distortion.

    What is left of the shape is filled on the left and on top, as LeRobot does for SmolVLA; sizes
    are rounded down, interpolation is bilinear without a filter.
    """
    have = images.shape[-2:]
    if tuple(have) == (height, width):
        return images
    ratio = max(have[1] / width, have[0] / height)
    rows, columns = int(have[0] / ratio), int(have[1] / ratio)
    resized = functional.interpolate(images, (rows, columns), mode="bilinear", align_corners=False)
    return functional.pad(resized, (width - columns, 0, height - rows, 0), value=fill)
