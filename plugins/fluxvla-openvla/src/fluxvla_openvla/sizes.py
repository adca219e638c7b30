"""The sizes of a model's parts, as tables of a config name them; the defaults are OpenVLA-7B's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, TypeVar

from fluxvla_core.errors import ConfigError

Size = TypeVar("Size")
HEADS = ("l1", "diffusion")
"""The action heads of OpenVLA-OFT."""


@dataclass(frozen=True)
class TowerSize:
    """A vision transformer.

    Args:
        width, depth, num_heads, mlp_width: of its blocks.
        patch_size: pixels of a patch's side.
        class_tokens: tokens in front of the patches: DINOv2 has one for the class and four
            registers, SigLIP none.
        layer_scale: whether each residual branch is multiplied by learnt factors (DINOv2).
        pooled: whether the published weights hold SigLIP's pooling head, which is not used.
    """

    width: int
    depth: int
    num_heads: int
    mlp_width: int
    patch_size: int = 14
    class_tokens: int = 0
    layer_scale: bool = False
    pooled: bool = False


DINOV2_L = TowerSize(1024, 24, 16, 4096, class_tokens=5, layer_scale=True)
"""ViT-L/14 of DINOv2 with registers (timm's ``vit_large_patch14_reg4_dinov2``)."""
SIGLIP_SO400M = TowerSize(1152, 27, 16, 4304, pooled=True)
"""SoViT-400M/14 of SigLIP (timm's ``vit_so400m_patch14_siglip_224``)."""


@dataclass(frozen=True)
class LanguageSize:
    """A Llama model; the names are those of its ``config.json``.

    Args:
        vocab_size: rows of the embedding; OpenVLA appended 64 to Llama's 32000, as padding.
        text_vocab_size: tokens of the tokenizer, whose last 256 stand for actions.
        rms_norm_eps: 1e-6 in the Hugging Face layout of OpenVLA-7B, whose ``text_config`` does not
            set it; 1e-5, as Llama 2 was trained, where the native layout is run.
        stop_token: the id of ``</s>``.
    """

    hidden_size: int = 4096
    intermediate_size: int = 11008
    num_hidden_layers: int = 32
    num_attention_heads: int = 32
    num_key_value_heads: int = 32
    vocab_size: int = 32064
    text_vocab_size: int = 32000
    rms_norm_eps: float = 1e-6
    rope_theta: float = 10000.0
    max_position_embeddings: int = 2048
    stop_token: int = 2


def read_size(table: Mapping[str, Any] | Size | None, default: Size, where: str) -> Size:
    """``default`` with what ``table`` sets.

    Args:
        table: keys of the dataclass of ``default``, or one already made; None is ``default``.
        where: the parameter that it was given as, for errors.

    Raises:
        ConfigError: an unknown key, or a value of another type or below 0.
    """
    if table is None:
        return default
    if isinstance(table, type(default)):
        return table
    if not isinstance(table, Mapping):
        raise ConfigError(f"{where} must be a table, got {table!r}")
    values = {field.name: vars(default)[field.name] for field in fields(default)}  # type: ignore[arg-type]
    for key, value in table.items():
        if key not in values:
            raise ConfigError(f"{where} has no {key!r}; it has {', '.join(values)}")
        kind = type(values[key])
        number = isinstance(value, int | float) and not isinstance(value, bool)
        fits = isinstance(value, bool) if kind is bool else number and value == kind(value)
        if not fits or value < 0:
            raise ConfigError(f"{where}.{key} must be of type {kind.__name__}, got {value!r}")
        values[key] = kind(value)
    return type(default)(**values)


def vocabulary(language: int | Mapping[str, Any] | LanguageSize | None) -> int:
    """Tokens that a language model of this size embeds; it may be their number itself."""
    if isinstance(language, int):
        return language
    return read_size(language, LanguageSize(), "language").vocab_size
