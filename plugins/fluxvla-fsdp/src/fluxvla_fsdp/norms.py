"""Norms, which compute in fp32 and take no weights in bf16."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import nn


def kept_fp32(model: nn.Module, device_type: str) -> set[nn.Module]:
    """The trained norms whose weights are gathered in fp32 where others are gathered in bf16.

    Batch and instance norms take weights of the dtype of their running statistics, or of an input
    in fp32. So do layer and group norms on a CPU, while autocast casts for them on a GPU.
    """
    from torch import nn
    from torch.nn.modules.batchnorm import _NormBase

    kinds: tuple[type[nn.Module], ...] = (_NormBase,)
    if device_type == "cpu":
        kinds = (*kinds, nn.LayerNorm, nn.GroupNorm)
    return {
        module
        for module in model.modules()
        if isinstance(module, kinds) and any(p.requires_grad for p in module.parameters())
    }
