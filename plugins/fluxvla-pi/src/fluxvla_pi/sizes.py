"""Sizes of the networks: published ones by name, others as tables.

Sources: PaliGemma (Beyer et al. 2024, arXiv 2407.07726) for ``gemma_2b`` and ``so400m``, pi0 (Black
et al. 2024, arXiv 2410.24164) for ``gemma_300m``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TypeVar

from fluxvla_core.errors import ConfigError


@dataclass(frozen=True)
class GemmaSize:
    """A Gemma decoder: ``depth`` layers of ``width``, with ``heads`` queries to ``kv_heads``."""

    width: int
    depth: int
    mlp_dim: int
    heads: int
    kv_heads: int
    head_dim: int


@dataclass(frozen=True)
class SiglipSize:
    """A SigLIP vision tower; ``image_size`` and ``patch_size`` in pixels, both ways."""

    width: int
    depth: int
    mlp_dim: int
    heads: int
    image_size: int
    patch_size: int

    @property
    def patches(self) -> int:
        """Tokens of one image."""
        return (self.image_size // self.patch_size) ** 2


GEMMA = {
    "gemma_2b": GemmaSize(2048, 18, 16384, 8, 1, 256),
    "gemma_300m": GemmaSize(1024, 18, 4096, 8, 1, 256),
    "dummy": GemmaSize(64, 4, 128, 8, 1, 16),
}
SIGLIP = {
    "so400m": SiglipSize(1152, 27, 4304, 16, 224, 14),
    "dummy": SiglipSize(32, 2, 64, 4, 56, 14),
}
Size = TypeVar("Size", GemmaSize, SiglipSize)


def gemma_size(given: str | Mapping[str, int], key: str) -> GemmaSize:
    """The size that a config names, or writes out as a table; ``key`` is the config's.

    Raises:
        ConfigError: an unknown name, other keys than a size has, or numbers that fit no network.
    """
    size = _size(given, key, GEMMA, GemmaSize)
    if size.heads % size.kv_heads or size.head_dim % 2:
        raise ConfigError(
            f"{key}: heads {size.heads} must be a multiple of kv_heads {size.kv_heads}, "
            f"and head_dim {size.head_dim} even"
        )
    return size


def siglip_size(given: str | Mapping[str, int], key: str) -> SiglipSize:
    """As ``gemma_size``, of a vision tower."""
    size = _size(given, key, SIGLIP, SiglipSize)
    if size.width % size.heads or size.image_size % size.patch_size:
        raise ConfigError(
            f"{key}: width {size.width} must be a multiple of heads {size.heads}, "
            f"and image_size {size.image_size} one of patch_size {size.patch_size}"
        )
    return size


def image_side(vision_variant: str | Mapping[str, int]) -> int:
    """Pixels of the side of the images that a vision tower of this size sees."""
    return siglip_size(vision_variant, "vision_variant").image_size


def _size(
    given: str | Mapping[str, int], key: str, known: Mapping[str, Size], kind: type[Size]
) -> Size:
    names = [field.name for field in fields(kind)]
    if isinstance(given, str):
        if given not in known:
            raise ConfigError(
                f"{key}: {given!r} is not one of {', '.join(known)}",
                next=f"or give a table with {', '.join(names)}",
            )
        return known[given]
    if sorted(given) != sorted(names):
        raise ConfigError(f"{key}: a size has {', '.join(names)}; got {', '.join(given)}")
    bad = {name: given[name] for name in names if given[name] < 1}
    if bad:
        raise ConfigError(f"{key}: every number must be at least 1, got {bad}")
    return kind(**given)
