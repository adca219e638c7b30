"""Optimizer state by parameter name, as checkpoints hold it, and back to a ``state_dict``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from fluxvla_core.checkpoints.shards import Stored
from fluxvla_core.checkpoints.tensors import shard_like
from fluxvla_core.errors import CheckpointError

NamedState = dict[str, Tensor]


def named_state(
    model: nn.Module, optimizer: torch.optim.Optimizer
) -> tuple[NamedState, dict[str, Any]]:
    """An optimizer's state as tensors ``<parameter>/<key>`` and a JSON description of the rest."""
    names = {id(parameter): name for name, parameter in model.named_parameters()}
    tensors: NamedState = {}
    scalars: dict[str, Any] = {}
    for parameter, state in optimizer.state.items():
        for key, value in state.items():
            place = f"{names[id(parameter)]}/{key}"
            (tensors if isinstance(value, Tensor) else scalars)[place] = value
    groups = [
        {
            **{k: v for k, v in group.items() if k != "params"},
            "params": [names[id(p)] for p in group["params"]],
        }
        for group in optimizer.param_groups
    ]
    return tensors, {"type": type(optimizer).__name__, "groups": groups, "scalars": scalars}


def torch_state(
    model: nn.Module,
    optimizer: torch.optim.Optimizer,
    tensors: Mapping[str, Tensor | Stored],
    described: Mapping[str, Any],
    where: str,
) -> dict[str, Any]:
    """The inverse of :func:`named_state`, in the form that ``load_state_dict`` takes.

    Hyperparameters are the present config's, apart from the learning rate, which the scheduler
    goes on with; state is sharded as the parameters are.

    Raises:
        CheckpointError: other parameters, sizes, groups or another optimizer.
    """
    names = {id(parameter): name for name, parameter in model.named_parameters()}
    own_groups = [[names[id(p)] for p in group["params"]] for group in optimizer.param_groups]
    saved_groups = [group["params"] for group in described["groups"]]
    if described["type"] != type(optimizer).__name__ or own_groups != saved_groups:
        raise CheckpointError(
            f"the optimizer of the checkpoint ({described['type']}, groups of "
            f"{[len(g) for g in saved_groups]} parameters) is not this run's "
            f"({type(optimizer).__name__}, {[len(g) for g in own_groups]})",
            where=where,
            cause="the model or the optimizer settings of the config have changed",
            next="resume with the config that made it: config.resolved.json in its folder",
        )
    parameters = {names[id(p)]: p for group in optimizer.param_groups for p in group["params"]}
    index = {name: i for i, name in enumerate(name for group in own_groups for name in group)}
    state: dict[int, dict[str, Any]] = {}
    for place, value in {**tensors, **described["scalars"]}.items():
        name, _, key = place.rpartition("/")
        if name not in index:
            raise CheckpointError(
                f"the checkpoint's optimizer has a state of {name!r}, which is not trained here",
                where=where,
            )
        if isinstance(value, Tensor | Stored):
            same = value.shape == parameters[name].shape
            everything = tuple(slice(0, n) for n in value.shape)
            # A copy: what was read may be a view of the checkpoint's file.
            value = (shard_like(parameters[name], value) if same else value[everything]).clone()
        state.setdefault(index[name], {})[key] = value
    groups, first = [], 0
    for mine, saved in zip(optimizer.param_groups, described["groups"], strict=True):
        rates = {k: saved[k] for k in ("lr", "initial_lr") if k in saved}
        group = {**{k: v for k, v in mine.items() if k != "params"}, **rates}
        group["params"] = list(range(first, first + len(mine["params"])))
        first += len(mine["params"])
        groups.append(group)
    return {"state": state, "param_groups": groups}


@dataclass(frozen=True)
class SavedGroup:
    """One group of an optimizer, its parameters by name."""

    params: list[str]
    lr: Any = None


@dataclass(frozen=True)
class SavedOptimizer:
    """``optimizer.json``; see :func:`named_state`."""

    type: str
    groups: list[SavedGroup]
    scalars: dict[str, Any]
