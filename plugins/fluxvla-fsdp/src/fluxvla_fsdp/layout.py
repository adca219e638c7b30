"""Memory of one process under ``fully_shard``, as torch 2.13 implements it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from fluxvla_core.training import Layout, bare, decay_groups, nbytes, trainable

if TYPE_CHECKING:
    from torch import nn

    from fluxvla_fsdp.groups import Group

FP32 = 4
"""Bytes of a gradient that is reduced."""


@dataclass(frozen=True)
class _Gathered:
    """Bytes of a group's weights as they are gathered, and of its gradients on their way."""

    weights: int
    gradients: int
    reshards: bool


def sharded(
    model: nn.Module,
    groups: Sequence[Group],
    parts: int,
    compute_dtype: torch.dtype | None,
    accumulates: bool,
) -> Layout:
    """The layout of the first of ``parts`` processes, which has the largest shards.

    A weight is cut along its first dimension, which is filled up to a multiple of ``parts``. While
    gradients are accumulated, they are kept whole: they are exchanged once.

    At most at a time, the weights of two units that are let go of are gathered (the next one is
    fetched while one computes), and gradients of one are on their way.

    Args:
        groups: of ``groups_of``.
        compute_dtype: what weights are gathered in; None for their own.
        accumulates: several batches make a step.
    """
    frozen = [p for p in model.parameters() if not p.requires_grad]
    trained = list(trainable(model).values())
    shards = {p: (math.ceil(p.shape[0] / parts), *p.shape[1:]) for p in trained}
    local = sum(math.prod(shape) * p.element_size() for p, shape in shards.items())
    names = {id(p): name for name, p in model.named_parameters()}
    gathered_as = {}
    gathered: list[_Gathered] = []
    seen: set[int] = set()
    for group in groups:
        weights = gradients = 0
        for parameter in group.parameters():
            if id(parameter) in seen:
                continue
            seen.add(id(parameter))
            size = parameter.element_size()
            if group.lowered and compute_dtype is not None:
                size = compute_dtype.itemsize
                gathered_as[names[id(parameter)]] = compute_dtype
            weights += parameter.numel() * size
            gradients += parameter.numel() * (size + FP32)
        gathered.append(_Gathered(weights, gradients, group.reshards))
    passing = sorted((one.weights for one in gathered if one.reshards), reverse=True)
    return Layout(
        parameters=local + nbytes([*frozen, *model.buffers()]),
        gradients=nbytes(trained) if accumulates else local,
        optimized=[
            [bare(shards[p], p.dtype) for p in group["params"]]
            for group in decay_groups(model, 0.0)
        ],
        gathered=sum(one.weights for one in gathered if not one.reshards)
        + sum(passing[:2])
        + max((one.gradients for one in gathered), default=0),
        gathered_as=gathered_as,
    )
