"""The SigLIP vision tower (Zhai et al. 2023, arXiv 2303.15343): a ViT without a pooling head."""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional

from fluxvla_core.errors import ConfigError
from fluxvla_pi.sizes import SiglipSize

EPS = 1e-6


class SiglipAttention(nn.Module):
    """Attention of every patch to every other, with biases."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.q_proj = nn.Linear(width, width)
        self.k_proj = nn.Linear(width, width)
        self.v_proj = nn.Linear(width, width)
        self.out_proj = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        query, key, value = (
            part(x).unflatten(-1, (self.heads, -1)).transpose(1, 2)
            for part in (self.q_proj, self.k_proj, self.v_proj)
        )
        attended = functional.scaled_dot_product_attention(query, key, value)
        return self.out_proj(attended.transpose(1, 2).flatten(2))


class SiglipMLP(nn.Module):
    """Two layers with the tanh approximation of GELU between."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, hidden)
        self.fc2 = nn.Linear(hidden, width)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(functional.gelu(self.fc1(x), approximate="tanh"))


class SiglipLayer(nn.Module):
    """A transformer layer, normalised before each of its parts."""

    def __init__(self, size: SiglipSize) -> None:
        super().__init__()
        self.layer_norm1 = nn.LayerNorm(size.width, eps=EPS)
        self.self_attn = SiglipAttention(size.width, size.heads)
        self.layer_norm2 = nn.LayerNorm(size.width, eps=EPS)
        self.mlp = SiglipMLP(size.width, size.mlp_dim)

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.self_attn(self.layer_norm1(x))
        return x + self.mlp(self.layer_norm2(x))


class SiglipVisionTower(nn.Module):
    """Images of one size to one token a patch."""

    def __init__(self, size: SiglipSize) -> None:
        super().__init__()
        self.size = size
        self.patch_embedding = nn.Conv2d(3, size.width, size.patch_size, stride=size.patch_size)
        self.position_embedding = nn.Embedding(size.patches, size.width)
        self.layers = nn.ModuleList(SiglipLayer(size) for _ in range(size.depth))
        self.post_layernorm = nn.LayerNorm(size.width, eps=EPS)

    def forward(self, images: Tensor) -> Tensor:
        """``(B, 3, H, W)`` in -1..1 -> ``(B, patches, width)``.

        Raises:
            ConfigError: the images have another size than the tower was made for.
        """
        side = self.size.image_size
        if images.shape[1:] != (3, side, side):
            raise ConfigError(
                f"the vision tower takes images of 3 x {side} x {side}, "
                f"got {' x '.join(str(n) for n in images.shape[1:])}",
                next=f"dict(type='ResizeImagesWithPad', height={side}, width={side}) "
                "in the dataset's transforms",
            )
        x = self.patch_embedding(images).flatten(2).transpose(1, 2)
        x = x + self.position_embedding.weight
        for layer in self.layers:
            x = layer(x)
        return self.post_layernorm(x)
