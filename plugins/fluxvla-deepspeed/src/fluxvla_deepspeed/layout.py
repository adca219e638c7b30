"""Memory of one process under ZeRO, as DeepSpeed 0.19 implements it.

Weights, gradients and their sums are fp32 here in every stage, also in mixed precision.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from fluxvla_core.training import Layout, bare, decay_groups, nbytes, trainable, units_of

if TYPE_CHECKING:
    from torch import nn

FP32 = 4
BUCKET = 500_000_000
"""Elements of the buffer that gradients are reduced in (DeepSpeed's ``reduce_bucket_size``)."""
ALIGNMENT = 2
"""Each process's part of a flat group is a multiple of this (``nccl_start_alignment_factor``)."""
PERSISTENT = 100_000
"""Parameters with fewer elements stay whole in stage 3 (``stage3_param_persistence_threshold``)."""
PREFETCHED = 50_000_000
"""Elements that stage 3 gathers ahead (``stage3_prefetch_bucket_size``)."""


def partitioned(model: nn.Module, stage: int, processes: int) -> Layout:
    """The layout of ``model`` on one of ``processes`` in ZeRO's ``stage``."""
    return _split(model, processes) if stage == 3 else _flat(model, stage, processes)


def _flat(model: nn.Module, stage: int, processes: int) -> Layout:
    """Stages 1 and 2: full weights, flat by group; of its part each process has a copy, too."""
    step = ALIGNMENT * processes
    counts = [sum(p.numel() for p in group["params"]) for group in decay_groups(model, 0.0)]
    flats = [math.ceil(count / step) * step for count in counts]
    parts = [flat // processes for flat in flats]
    frozen = [p for p in model.parameters() if not p.requires_grad]
    whole = nbytes(trainable(model).values())
    return Layout(
        parameters=(sum(flats) + sum(parts)) * FP32 + nbytes([*frozen, *model.buffers()]),
        gradients=whole if stage == 1 else sum(parts) * FP32,
        optimized=[[bare((part,), torch.float32)] for part in parts],
        gathered=BUCKET * FP32,
    )


def _split(model: nn.Module, processes: int) -> Layout:
    """Stage 3: a part of every weight, frozen ones too; small ones are whole besides. Of the parts
    that are trained the optimizer has a copy."""

    def part(parameter: nn.Parameter) -> int:
        return math.ceil(parameter.numel() / processes)

    parameters = list(model.parameters())
    groups = decay_groups(model, 0.0)
    own = [sum(part(p) for p in group["params"]) for group in groups]
    small = sum(p.numel() for p in parameters if p.numel() < PERSISTENT)
    units = [sum(p.numel() for m in unit for p in m.parameters()) for unit in units_of(model)]
    largest = max([*units, *(p.numel() for p in parameters)])
    return Layout(
        parameters=(sum(map(part, parameters)) + sum(own)) * FP32 + nbytes(model.buffers()),
        gradients=sum(own) * FP32,
        optimized=[[bare((count,), torch.float32)] for count in own],
        gathered=(small + largest + PREFETCHED + BUCKET) * FP32,
    )
