"""Sizes of SmolVLA's parts; the defaults are those of SmolVLM2-500M, which LeRobot publishes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, TypeVar

from fluxvla_core.errors import ConfigError


@dataclass(frozen=True)
class VisionSize:
    """The vision tower: a SigLIP transformer on square images.

    Args:
        hidden_size, intermediate_size: widths of the residual stream and of its MLPs.
        layers, heads: their numbers.
        image_size, patch_size: pixels along a side.
        layer_norm_eps: added to the variance.
        scale_factor: so many patches along a side become one token (pixel shuffle).
    """

    hidden_size: int = 768
    intermediate_size: int = 3072
    layers: int = 12
    heads: int = 12
    image_size: int = 512
    patch_size: int = 16
    layer_norm_eps: float = 1e-6
    scale_factor: int = 4

    def __post_init__(self) -> None:
        _divides("hidden_size", self.hidden_size, "heads", self.heads)
        _divides("image_size", self.image_size, "patch_size", self.patch_size)
        _divides("patches along a side", self.side, "scale_factor", self.scale_factor)

    @property
    def side(self) -> int:
        """Patches along a side of an image."""
        return self.image_size // self.patch_size


@dataclass(frozen=True)
class TextSize:
    """The language model: the first ``layers`` layers of SmolLM2, a Llama.

    Args:
        hidden_size, intermediate_size: widths of the residual stream and of its MLPs.
        layers: how many are used; SmolVLM2-500M has 32, SmolVLA takes 16.
        heads, kv_heads, head_dim: of the attention; several heads share keys and values.
        vocabulary: rows of the token embedding.
        rms_norm_eps: added to the mean square.
    """

    hidden_size: int = 960
    intermediate_size: int = 2560
    layers: int = 16
    heads: int = 15
    kv_heads: int = 5
    head_dim: int = 64
    vocabulary: int = 49280
    rms_norm_eps: float = 1e-5

    def __post_init__(self) -> None:
        _divides("heads", self.heads, "kv_heads", self.kv_heads)
        _divides("head_dim", self.head_dim, "2", 2)


Size = TypeVar("Size", VisionSize, TextSize)


def size_of(kind: type[Size], given: Size | Mapping[str, Any] | None) -> Size:
    """The size that a config's table describes; the default one where there is none.

    Raises:
        ConfigError: the table has a key that is not a field, or values that do not fit.
    """
    if isinstance(given, kind):
        return given
    table = dict(given or {})
    known = [field.name for field in fields(kind)]
    unknown = sorted(set(table) - set(known))
    if unknown:
        raise ConfigError(
            f"SmolVLA: {kind.__name__} has no {unknown[0]!r}; it has {', '.join(known)}"
        )
    return kind(**table)


def expert_size(text: TextSize, layers: int, width_multiplier: float) -> TextSize:
    """The action expert's size: narrower layers whose heads are those of ``text``.

    The MLP has 4/3 * 2 of the width, rounded up to 256, as Llama sizes it.
    """
    width = int(text.hidden_size * width_multiplier)
    if width < 2 or width % 2:
        raise ConfigError(
            f"SmolVLA: the expert is {width} wide (hidden_size {text.hidden_size} times "
            f"expert_width_multiplier {width_multiplier}), an even width is needed for sines in "
            "pairs with cosines"
        )
    inner = 4 * int(2 * width / 3)
    return TextSize(
        hidden_size=width,
        intermediate_size=256 * -(-inner // 256),
        layers=layers,
        heads=text.heads,
        kv_heads=text.kv_heads,
        head_dim=text.head_dim,
        vocabulary=text.vocabulary,
        rms_norm_eps=text.rms_norm_eps,
    )


def _divides(what: str, value: int, by: str, divisor: int) -> None:
    if value < 1 or divisor < 1 or value % divisor:
        raise ConfigError(f"SmolVLA: {what} {value} is not a multiple of {by} {divisor}")
