"""Trainable parameters of a model: groups for weight decay, gradient clipping, memory layout.

A strategy's ``memory_layout`` says what one process keeps of a model while it trains. Nothing there
allocates: tensors stand for their shapes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from fluxvla_core.checkpoints.tensors import full_tensor
from fluxvla_core.errors import ConfigError


def trainable(model: nn.Module) -> dict[str, nn.Parameter]:
    """Parameters that are trained, by name; a tied one once, under its first name."""
    return {name: p for name, p in model.named_parameters() if p.requires_grad}


def refuse_scalars(parameters: Mapping[str, nn.Parameter], runner: str, where: str | None) -> None:
    """Refuse parameters without dimensions, for a strategy that cuts along one.

    Raises:
        ConfigError: names one of them.
    """
    for name, parameter in parameters.items():
        if parameter.ndim == 0:
            raise ConfigError(
                f"{name} is a parameter without dimensions, which {runner} cannot split",
                where=where,
                cause="a parameter is split over the processes along a dimension",
                next="give it one, as nn.Parameter(torch.ones(1)) has, or use DDPTrainRunner",
            )


def decay_groups(model: nn.Module, weight_decay: float) -> list[dict[str, Any]]:
    """Two groups: matrices with ``weight_decay``; biases, norms and other vectors without.

    Raises:
        ConfigError: nothing is trainable.
    """
    parameters = trainable(model)
    if not parameters:
        raise ConfigError(
            "the model has no trainable parameter", cause="all of its parts are frozen"
        )
    decayed = {n: p for n, p in parameters.items() if p.ndim > 1 and not n.endswith("bias")}
    rest = [p for n, p in parameters.items() if n not in decayed]
    groups = [
        {"params": list(decayed.values()), "weight_decay": weight_decay},
        {"params": rest, "weight_decay": 0.0},
    ]
    return [group for group in groups if group["params"]]


def gradient_norm(parameters: list[nn.Parameter]) -> Tensor:
    """The norm of all gradients over all ranks, a scalar on the device."""
    return full_tensor(
        torch.nn.utils.get_total_norm([p.grad for p in parameters if p.grad is not None])
    )


def clip_(parameters: list[nn.Parameter], max_norm: float) -> Tensor:
    """Scale gradients in place so that their norm over all ranks is at most ``max_norm``.

    Returns:
        The norm before, a scalar on the device.
    """
    # Gathered once, here: torch.nn.utils.clip_grad_norm_ would do it again for the caller.
    norm = gradient_norm(parameters)
    torch.nn.utils.clip_grads_with_norm_(parameters, max_norm, norm)
    return norm


@dataclass(frozen=True)
class Layout:
    """What one process keeps of a model; of processes that keep different amounts, the fullest.

    Args:
        parameters: bytes of weights and buffers.
        gradients: bytes of gradients when the backward pass ends.
        optimized: what the optimizer is given, a sequence for each of its groups: tensors without
            memory (torch's meta device).
        gathered: bytes of weights that are put together to compute with, and of what exchanging
            gradients needs, at most at a time.
        gathered_as: name of a weight -> the dtype that it is gathered in, where it is another.
    """

    parameters: int
    gradients: int
    optimized: Sequence[Sequence[Tensor]]
    gathered: int = 0
    gathered_as: Mapping[str, torch.dtype] = field(default_factory=dict)


def replicated_layout(model: nn.Module) -> Layout:
    """The layout of data parallelism, and of one process: everything on every process."""
    groups = decay_groups(model, 0.0)
    return Layout(
        parameters=nbytes([*model.parameters(), *model.buffers()]),
        gradients=nbytes(trainable(model).values()),
        optimized=[[bare(p.shape, p.dtype) for p in group["params"]] for group in groups],
    )


def bare(shape: Sequence[int], dtype: torch.dtype) -> Tensor:
    """A tensor without memory."""
    return torch.empty(tuple(shape), dtype=dtype, device="meta")


def nbytes(tensors: Iterable[Tensor]) -> int:
    """Bytes of all their elements."""
    return sum(t.numel() * t.element_size() for t in tensors)
