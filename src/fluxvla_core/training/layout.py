"""Memory layout: what one process keeps of a model while it trains under a strategy.

A strategy says so by ``memory_layout``. Nothing here allocates: tensors stand for their shapes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from fluxvla_core.training.parameters import decay_groups, trainable


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
