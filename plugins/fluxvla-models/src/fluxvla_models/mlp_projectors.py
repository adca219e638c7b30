"""Projectors from a vision encoder's patch features to a language model's embeddings."""

from __future__ import annotations

from torch import Tensor, nn

from fluxvla_core.errors import ConfigError


class LinearProjector(nn.Module):
    """One matrix (Liu et al. 2023, LLaVA).

    Args:
        in_dim, out_dim: widths; the model fills them in.
    """

    def __init__(self, in_dim: int | None = None, out_dim: int | None = None) -> None:
        super().__init__()
        self.out_dim = _known(self, in_dim, out_dim)[1]
        self.projector = nn.Linear(*_known(self, in_dim, out_dim))

    def forward(self, features: Tensor) -> Tensor:
        """``(B, L, in_dim)`` -> ``(B, L, out_dim)``."""
        return self.projector(features)

    def fsdp_units(self) -> list[nn.Module]:
        """No units: the projector is too small to shard by itself."""
        return []


class FusedMLPProjector(nn.Module):
    """Three matrices, the first four times as wide (Karamcheti et al. 2024, Prismatic VLMs).

    Args:
        in_dim, out_dim: widths; the model fills them in.
        mid_dim: width of the first; four times ``in_dim`` by default.
    """

    def __init__(
        self, in_dim: int | None = None, out_dim: int | None = None, mid_dim: int | None = None
    ) -> None:
        super().__init__()
        first, last = _known(self, in_dim, out_dim)
        middle = 4 * first if mid_dim is None else mid_dim
        self.out_dim = last
        self.projector = nn.Sequential(
            nn.Linear(first, middle),
            nn.GELU(),
            nn.Linear(middle, last),
            nn.GELU(),
            nn.Linear(last, last),
        )

    def forward(self, features: Tensor) -> Tensor:
        """``(B, L, in_dim)`` -> ``(B, L, out_dim)``."""
        return self.projector(features)

    def fsdp_units(self) -> list[nn.Module]:
        """No units: the projector is too small to shard by itself."""
        return []


def _known(part: nn.Module, in_dim: int | None, out_dim: int | None) -> tuple[int, int]:
    if in_dim is None or out_dim is None:
        raise ConfigError(f"{type(part).__name__} needs in_dim and out_dim")
    return in_dim, out_dim
