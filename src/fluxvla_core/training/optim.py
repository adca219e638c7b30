"""Parameter groups, gradient clipping, optimizer state by name, schedules, averaged weights."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from fluxvla_core.checkpoints.parts import Stored, local
from fluxvla_core.checkpoints.tensors import check_names, copy_whole, like, whole
from fluxvla_core.errors import CheckpointError, ConfigError
from fluxvla_core.training.schedule import Schedule

NamedState = dict[str, Tensor]


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
    return whole(torch.nn.utils.get_total_norm([p.grad for p in parameters if p.grad is not None]))


def clip_(parameters: list[nn.Parameter], max_norm: float) -> Tensor:
    """Scale gradients in place so that their norm over all ranks is at most ``max_norm``.

    Returns:
        The norm before, a scalar on the device.
    """
    # Gathered once, here: torch.nn.utils.clip_grad_norm_ would do it again for the caller.
    norm = gradient_norm(parameters)
    torch.nn.utils.clip_grads_with_norm_(parameters, max_norm, norm)
    return norm


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
    ours = [[names[id(p)] for p in group["params"]] for group in optimizer.param_groups]
    theirs = [group["params"] for group in described["groups"]]
    if described["type"] != type(optimizer).__name__ or ours != theirs:
        raise CheckpointError(
            f"the optimizer of the checkpoint ({described['type']}, groups of "
            f"{[len(g) for g in theirs]} parameters) is not this run's "
            f"({type(optimizer).__name__}, {[len(g) for g in ours]})",
            where=where,
            cause="the model or the optimizer settings of the config have changed",
            next="resume with the config that made it: config.resolved.json in its folder",
        )
    parameters = {names[id(p)]: p for group in optimizer.param_groups for p in group["params"]}
    index = {name: i for i, name in enumerate(name for group in ours for name in group)}
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
            value = (like(parameters[name], value) if same else value[everything]).clone()
        state.setdefault(index[name], {})[key] = value
    groups, first = [], 0
    for mine, saved in zip(optimizer.param_groups, described["groups"], strict=True):
        kept = {k: saved[k] for k in ("lr", "initial_lr") if k in saved}
        group = {**{k: v for k, v in mine.items() if k != "params"}, **kept}
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


class ScheduledLR(torch.optim.lr_scheduler.LRScheduler):
    """Sets every group's rate to ``schedule(step)``; its state is the step alone.

    A group that the optimizer was built with at a multiple of ``learning_rate`` keeps to it.
    """

    def __init__(
        self, optimizer: torch.optim.Optimizer, schedule: Schedule, learning_rate: float
    ) -> None:
        self.schedule, self.learning_rate = schedule, learning_rate
        super().__init__(optimizer)

    def get_lr(self) -> list[float | torch.Tensor]:
        rate = self.schedule(self.last_epoch)
        return [rate * (float(base) / self.learning_rate) for base in self.base_lrs]

    def state_dict(self) -> dict[str, Any]:
        return {"step": self.last_epoch}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.last_epoch = state_dict["step"]
        for group, rate in zip(self.optimizer.param_groups, self.get_lr(), strict=True):
            group["lr"] = rate
        self._last_lr = [group["lr"] for group in self.optimizer.param_groups]


class Ema:
    """Exponential moving average of the trainable weights, sharded as they are.

    The decay of the ``n``-th update is ``min(decay, (1 + n) / (10 + n))``: early averages then
    forget the random start (as tf.train.ExponentialMovingAverage does with ``num_updates``).
    """

    def __init__(self, parameters: Mapping[str, nn.Parameter], decay: float) -> None:
        self.decay = decay
        self._parameters = parameters
        self.shadow = {name: p.detach().clone() for name, p in parameters.items()}

    def update(self, step: int) -> None:
        """Move towards the weights after optimizer step ``step`` (from 1)."""
        decay = min(self.decay, (1 + step) / (10 + step))
        with torch.no_grad():
            torch._foreach_lerp_(
                [local(t) for t in self.shadow.values()],
                [local(p) for p in self._parameters.values()],
                1.0 - decay,
            )

    @contextmanager
    def in_place(self) -> Iterator[None]:
        """The model has the averages as its weights inside, and its own again afterwards."""
        self._swap()
        try:
            yield
        finally:
            self._swap()

    def _swap(self) -> None:
        with torch.no_grad():
            for name, parameter in self._parameters.items():
                ours, theirs = local(self.shadow[name]), local(parameter)
                kept = theirs.clone()
                theirs.copy_(ours)
                ours.copy_(kept)

    def load(self, tensors: Mapping[str, Tensor], where: str) -> None:
        """Take the full averages in ``tensors``.

        Raises:
            CheckpointError: names or sizes are not those of this model.
        """
        check_names(tensors, self.shadow, "the averaged weights", where)
        for name, average in self.shadow.items():
            copy_whole(average, tensors[name])
