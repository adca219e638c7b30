"""The vision backbone: DINOv2 and SigLIP side by side, their patch features joined.

The modules have the names that timm's vision transformers have in OpenVLA's published weights.
Source: Karamcheti et al., "Prismatic VLMs" (2024), and Kim et al., "OpenVLA" (2024).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from fluxvla_openvla.sizes import TowerSize

_EPS = 1e-6
_DINO_MEAN = (0.485, 0.456, 0.406)
_DINO_STD = (0.229, 0.224, 0.225)


class LayerScale(nn.Module):
    """Multiply by learnt factors, one a channel; the published name is ``scale_factor``."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.scale_factor = nn.Parameter(torch.full((width,), 1e-5))

    def forward(self, x: Tensor) -> Tensor:
        """``(..., width)``, same shape."""
        return x * self.scale_factor


class Attention(nn.Module):
    """Self-attention over all tokens."""

    def __init__(self, width: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """``(B, N, width)``, same shape."""
        batch, tokens, width = x.shape
        qkv = self.qkv(x).reshape(batch, tokens, 3, self.num_heads, width // self.num_heads)
        query, key, value = qkv.permute(2, 0, 3, 1, 4)
        attended = functional.scaled_dot_product_attention(query, key, value)
        return self.proj(attended.transpose(1, 2).reshape(batch, tokens, width))


class Mlp(nn.Module):
    """Two layers with a GELU between them."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, hidden)
        self.fc2 = nn.Linear(hidden, width)

    def forward(self, x: Tensor) -> Tensor:
        """``(..., width)``, same shape."""
        return self.fc2(functional.gelu(self.fc1(x)))


class Block(nn.Module):
    """Attention and MLP, each after a norm and added to its input.

    Args:
        size: of the tower.
        language_width: of the vector that modulates the features between the two (FiLM of
            OpenVLA-OFT+); 0 for none.
    """

    def __init__(self, size: TowerSize, language_width: int = 0) -> None:
        super().__init__()
        width = size.width
        self.norm1 = nn.LayerNorm(width, eps=_EPS)
        self.attn = Attention(width, size.num_heads)
        self.ls1 = LayerScale(width) if size.layer_scale else nn.Identity()
        self.norm2 = nn.LayerNorm(width, eps=_EPS)
        self.mlp = Mlp(width, size.mlp_width)
        self.ls2 = LayerScale(width) if size.layer_scale else nn.Identity()
        if language_width:
            self.scale = nn.Linear(language_width, width)
            self.shift = nn.Linear(language_width, width)

    def forward(self, x: Tensor, language: Tensor | None = None) -> Tensor:
        """``(B, N, width)`` and, for FiLM, ``(B, language_width)`` -> ``(B, N, width)``."""
        x = x + self.ls1(self.attn(self.norm1(x)))
        if language is not None:
            x = x * (1 + self.scale(language).unsqueeze(1)) + self.shift(language).unsqueeze(1)
        return x + self.ls2(self.mlp(self.norm2(x)))


class PatchEmbed(nn.Module):
    """Cut into square patches and project each."""

    def __init__(self, size: TowerSize) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, size.width, size.patch_size, size.patch_size)

    def forward(self, images: Tensor) -> Tensor:
        """``(B, 3, H, W)`` -> ``(B, N, width)``, row by row."""
        return self.proj(images).flatten(2).transpose(1, 2)


class PoolingHead(nn.Module):
    """SigLIP's pooling head, which is in the published weights. OpenVLA never calls it."""

    def __init__(self, size: TowerSize) -> None:
        super().__init__()
        width = size.width
        self.latent = nn.Parameter(torch.zeros(1, 1, width))
        self.q = nn.Linear(width, width)
        self.kv = nn.Linear(width, 2 * width)
        self.proj = nn.Linear(width, width)
        self.norm = nn.LayerNorm(width, eps=_EPS)
        self.mlp = Mlp(width, size.mlp_width)


class Tower(nn.Module):
    """One vision transformer; gives the patches of its second-to-last block.

    Its last block, its last norm and its pooling head are never used. They are kept, and frozen,
    so that published weights have a place for every tensor and can be written again.

    Args:
        size: of its parts.
        image_size: pixels of an image's side.
        language_width: see ``Block``.
    """

    def __init__(self, size: TowerSize, image_size: int, language_width: int = 0) -> None:
        super().__init__()
        width, patches = size.width, (image_size // size.patch_size) ** 2
        self.patch_embed = PatchEmbed(size)
        if size.class_tokens:
            self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
            self.reg_token = nn.Parameter(torch.zeros(1, size.class_tokens - 1, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, patches, width))
        self.blocks = nn.ModuleList(Block(size, language_width) for _ in range(size.depth))
        self.norm = nn.LayerNorm(width, eps=_EPS)
        self.class_tokens = size.class_tokens
        unused: list[nn.Module] = [self.blocks[-1], self.norm]
        if size.pooled:
            self.attn_pool = PoolingHead(size)
            unused.append(self.attn_pool)
        _initialize(self)
        for module in unused:
            module.requires_grad_(False)

    def used_blocks(self) -> list[nn.Module]:
        """The blocks that are computed."""
        return list(self.blocks)[:-1]

    def forward(self, images: Tensor, language: Tensor | None = None) -> Tensor:
        """``(B, 3, H, W)`` in this tower's normalisation -> ``(B, patches, width)``."""
        x = self.patch_embed(images) + self.pos_embed
        if self.class_tokens:
            front = torch.cat([self.cls_token, self.reg_token], 1)
            x = torch.cat([front.expand(len(x), -1, -1), x], 1)
        for block in self.used_blocks():
            x = block(x, language)
        return x[:, self.class_tokens :]


class DinoSiglip(nn.Module):
    """Both towers; for each patch the features of the first, then those of the second.

    Args:
        dino, siglip: sizes of the towers.
        image_size: pixels of an image's side.
        language_width: see ``Block``.
    """

    def __init__(
        self, dino: TowerSize, siglip: TowerSize, image_size: int, language_width: int = 0
    ) -> None:
        super().__init__()
        self.featurizer = Tower(dino, image_size, language_width)
        self.fused_featurizer = Tower(siglip, image_size, language_width)
        self.width = dino.width + siglip.width

    def forward(self, images: Tensor, language: Tensor | None = None) -> Tensor:
        """Images to features.

        Args:
            images: ``(B, 3N, H, W)`` in -1..1, which is SigLIP's normalisation.
            language: ``(B, language_width)`` for FiLM.

        Returns:
            ``(B, N * patches, width)``, one image after the other.
        """
        batch, planes = images.shape[:2]
        count = planes // 3
        single = images.reshape(batch * count, 3, *images.shape[2:])
        if language is not None:
            language = language.repeat_interleave(count, 0)
        patches = torch.cat(
            [self.featurizer(for_dino(single), language), self.fused_featurizer(single, language)],
            2,
        )
        return patches.reshape(batch, -1, self.width)


class Projector(nn.Module):
    """Three layers from the features of both towers to the language model's width."""

    def __init__(self, vision_width: int, language_width: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(vision_width, 4 * vision_width)
        self.fc2 = nn.Linear(4 * vision_width, language_width)
        self.fc3 = nn.Linear(language_width, language_width)

    def forward(self, features: Tensor) -> Tensor:
        """``(B, P, vision_width)`` -> ``(B, P, language_width)``."""
        hidden = functional.gelu(self.fc1(features))
        return self.fc3(functional.gelu(self.fc2(hidden)))


def for_dino(images: Tensor) -> Tensor:
    """Images ``(B, 3, H, W)`` in -1..1 -> normalised by ImageNet's mean and deviation."""
    # Plane by plane, with numbers that kernels are given by value: nothing is copied from the host.
    planes = zip(images.unbind(1), _DINO_MEAN, _DINO_STD, strict=True)
    return torch.stack([(plane * 0.5 + 0.5 - mean) / std for plane, mean, std in planes], 1)


def _initialize(tower: Tower) -> None:
    for module in tower.modules():
        if isinstance(module, nn.Linear):
            nn.init.trunc_normal_(module.weight, std=0.02)
            nn.init.zeros_(module.bias)
    for name, parameter in tower.named_parameters():
        if name.endswith(("pos_embed", "cls_token", "reg_token", "latent")):
            nn.init.trunc_normal_(parameter, std=0.02)
