"""Weights as a policy computes with them: in bf16 where autocast would cast them, or quantised.

Autocast casts the weights of matrix products and convolutions anew for each answer. Storing them so
gives the same numbers, halves their memory and saves the casts. Modules that compute in float32
whatever the precision (``VLA.exact_modules``) keep their weights.
"""

from __future__ import annotations

import importlib.util
from typing import Any

import torch
from torch import nn

from fluxvla_core.contracts.training import VLA
from fluxvla_core.errors import ConfigError
from fluxvla_core.training.model import blocks_of

QUANTIZATIONS = ("int8", "fp8", "fp8_dynamic")
"""``int8`` and ``fp8``: weights alone. ``fp8_dynamic``: activations, too, scaled row by row."""
_CAST = (nn.Linear, nn.Conv1d, nn.Conv2d, nn.Conv3d)
_FP8_CAPABILITY = (8, 9)


def store_in_bf16(model: nn.Module) -> None:
    """Store in bf16 what autocast would cast to it.

    A tensor that another kind of module shares (words that are looked up and predicted) stays
    float32, so that the other one reads what it read before.
    """
    exact = {id(part) for module in VLA.adapt(model).exact_modules() for part in module.modules()}
    others = {
        id(parameter)
        for module in model.modules()
        if type(module) not in _CAST or id(module) in exact
        for parameter in module.parameters(recurse=False)
    }
    for module in model.modules():
        if type(module) not in _CAST or id(module) in exact:
            continue
        for parameter in module.parameters(recurse=False):
            if id(parameter) not in others and parameter.dtype is torch.float32:
                parameter.data = parameter.data.to(torch.bfloat16)


def quantize(model: nn.Module, kind: str) -> int:
    """Quantise the linear layers of the model's blocks by torchao; how many there were.

    Layers outside the blocks (inputs and outputs of the robot's numbers) and
    ``VLA.exact_modules`` stay as they are.

    Raises:
        ConfigError: see :func:`check_quantization`; or the model names no blocks.
    """
    device = next(model.parameters()).device
    check_quantization(kind, device)
    from torchao.quantization import (  # type: ignore[import-not-found, unused-ignore]
        Float8DynamicActivationFloat8WeightConfig,
        Float8WeightOnlyConfig,
        Int8WeightOnlyConfig,
        PerRow,
        quantize_,
    )

    exact = {id(part) for module in VLA.adapt(model).exact_modules() for part in module.modules()}
    chosen = [
        part
        for block in blocks_of(model)
        for part in block.modules()
        if isinstance(part, nn.Linear) and id(part) not in exact
    ]
    if not chosen:
        raise ConfigError(
            f"quantization {kind!r}: {type(model).__name__} has no linear layers in its blocks",
            cause="it names none in fsdp_units()",
        )
    table: Any = {
        "int8": Int8WeightOnlyConfig,
        "fp8": Float8WeightOnlyConfig,
        "fp8_dynamic": lambda: Float8DynamicActivationFloat8WeightConfig(granularity=PerRow()),
    }[kind]()
    wanted = {id(part) for part in chosen}
    quantize_(model, table, lambda module, _: id(module) in wanted)
    return len(chosen)


def check_quantization(kind: str | None, device: torch.device | str) -> None:
    """Refuse what cannot be done here, before a model is built.

    Raises:
        ConfigError: the kind is unknown, torchao is not installed, or the device cannot compute it.
    """
    if kind is None:
        return
    if kind not in QUANTIZATIONS:
        raise ConfigError(
            f"quantization {kind!r} is unknown; choose one of {', '.join(QUANTIZATIONS)}"
        )
    if importlib.util.find_spec("torchao") is None:
        raise ConfigError(
            f"quantization {kind!r} needs the package torchao, which is not installed",
            next="pip install 'fluxvla-core[quantize]'",
        )
    if kind != "fp8_dynamic":
        return
    place = torch.device(device)
    have = torch.cuda.get_device_capability(place) if place.type == "cuda" else None
    if have is None or have < _FP8_CAPABILITY:
        said = f"{place}" if have is None else f"one of compute capability {have[0]}.{have[1]}"
        raise ConfigError(
            "quantization 'fp8_dynamic' needs a GPU of compute capability 8.9 or more (Ada, "
            f"Hopper, Blackwell), the device is {said}",
            next="quantization='int8' or 'fp8', which quantise the weights alone",
        )


def ready(model: Any, precision: str, quantization: str | None) -> Any:
    """``model`` with its weights as ``precision`` and ``quantization`` want them.

    Raises:
        ConfigError: see :func:`quantize`.
    """
    if precision == "bf16":
        store_in_bf16(model)
    if quantization is not None:
        quantize(model, quantization)
    return model
