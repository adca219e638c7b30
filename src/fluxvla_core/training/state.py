"""State of a training: progress, optimizer, averaged weights, random generators.

Each has a form that checkpoints hold: JSON values, or tensors by name.
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from fluxvla_core.bounds import Count
from fluxvla_core.checkpoints.shards import Stored, to_local
from fluxvla_core.checkpoints.tensors import check_names, copy_full, shard_like
from fluxvla_core.contracts.training import Dataset
from fluxvla_core.data.sampler import Cursor, order_rng
from fluxvla_core.errors import CheckpointError


@dataclass(frozen=True)
class SavedCursor:
    """The next sample."""

    epoch: Count
    samples: Count


@dataclass(frozen=True)
class SavedValidation:
    """Results of validation so far; absent where there was none."""

    best: float | None = None
    best_step: int = -1
    worse: Count = 0
    owed: dict[str, Any] | None = None


@dataclass(frozen=True)
class SavedTrainer:
    """``trainer.json`` as a resumed training needs it; ``scheduler`` and ``metric`` are what
    those classes made of their state."""

    global_step: Count
    cursor: SavedCursor
    train_loss: float | None
    scheduler: Any
    metric: Any
    step_samples: Count
    world_size: Count
    validation: SavedValidation = field(default_factory=SavedValidation)
    data_seeds: list[int | None] = field(default_factory=list)


@dataclass
class Progress:
    """Progress of a training run from step to step, and its part of ``trainer.json``.

    Args:
        step: optimizer steps done.
        cursor: the next sample.
        loss: mean loss of the last step that was fetched.
        saved: the step of the last checkpoint, -1 when there is none.
        best, best_step: lowest validation loss, and its step.
        bad_validations: validations since then.
        pending_validation: record of the last step, if a stop left it without its validation.
    """

    step: int = 0
    cursor: Cursor = field(default_factory=Cursor)
    loss: float | None = None
    saved: int = -1
    best: float | None = None
    best_step: int = -1
    bad_validations: int = 0
    pending_validation: dict[str, Any] | None = None

    def validated(self, loss: float) -> bool:
        """Take the validation loss of the present step; whether it is the best so far."""
        if self.best is None or loss < self.best:
            self.best, self.best_step, self.bad_validations = loss, self.step, 0
            return True
        self.bad_validations += 1
        return False

    def to_dict(self) -> dict[str, Any]:
        """JSON values; :meth:`from_dict` is the inverse."""
        pending = self.pending_validation
        owed = {} if pending is None else {"owed": pending}
        return {
            "global_step": self.step,
            "epoch": self.cursor.epoch,
            "cursor": {"epoch": self.cursor.epoch, "samples": self.cursor.samples},
            "train_loss": self.loss,
            "validation": {
                "best": self.best,
                "best_step": self.best_step,
                "worse": self.bad_validations,
                **owed,
            },
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Progress:
        """The progress that a checkpoint was saved with."""
        cursor = Cursor(data["cursor"]["epoch"], data["cursor"]["samples"])
        step = data["global_step"]
        validation = data.get("validation", {})
        return cls(
            step,
            cursor,
            data["train_loss"],
            saved=step,
            best=validation.get("best"),
            best_step=validation.get("best_step", -1),
            bad_validations=validation.get("worse", 0),
            pending_validation=validation.get("owed"),
        )


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
                [to_local(t) for t in self.shadow.values()],
                [to_local(p) for p in self._parameters.values()],
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
                average, weight = to_local(self.shadow[name]), to_local(parameter)
                saved = weight.clone()
                weight.copy_(average)
                average.copy_(saved)

    def load(self, tensors: Mapping[str, Tensor], where: str) -> None:
        """Take the full averages in ``tensors``.

        Raises:
            CheckpointError: names or sizes are not those of this model.
        """
        check_names(tensors, self.shadow, "the averaged weights", where)
        for name, average in self.shadow.items():
            copy_full(average, tensors[name])


def seed_all(seed: int) -> None:
    """Seed python, numpy, torch and, where there is one, the GPU."""
    random.seed(seed)
    np.random.seed(seed % 2**32)
    torch.manual_seed(seed)


def seeds_of(dataset: Any) -> list[int | None]:
    """Seeds of ``dataset`` and then of the datasets that it is made of; None if unknown."""
    described = Dataset.adapt(dataset)
    seed, parts = described.seed, described.datasets
    below = [s for part in parts for s in seeds_of(part)] if isinstance(parts, list) else []
    return [seed if isinstance(seed, int) else None, *below]


def rank_seed(seed: int, rank: int, step: int = 0) -> int:
    """A seed for what a rank's own layers draw (dropout), different for every rank and step."""
    # The order itself takes numbers from the head of this stream; ranks are a jump away.
    stream = cast(np.random.Philox, order_rng(seed, step).bit_generator)
    return int(stream.jumped(rank + 1).random_raw()) >> 1


def rng_state() -> dict[str, Tensor]:
    """Everything needed to continue drawing where this process is; sizes are equal on all ranks."""
    version, words, gauss = random.getstate()
    _, key, position, has_gauss, cached = np.random.get_state(legacy=True)
    state = {
        "python": torch.tensor([version, *words], dtype=torch.int64),
        "python_gauss": torch.tensor(
            [gauss is not None, gauss if gauss is not None else 0.0], dtype=torch.float64
        ),
        "numpy": torch.from_numpy(np.asarray(key).astype(np.int64)),
        "numpy_position": torch.tensor([position, has_gauss], dtype=torch.int64),
        "numpy_gauss": torch.tensor([cached], dtype=torch.float64),
        "torch": torch.get_rng_state(),
    }
    if torch.cuda.is_available():
        state["cuda"] = torch.cuda.get_rng_state()
    return state


def set_rng_state(state: dict[str, Tensor]) -> None:
    """The inverse of :func:`rng_state`."""
    version, *words = state["python"].tolist()
    has, gauss = state["python_gauss"].tolist()
    random.setstate((version, tuple(words), gauss if has else None))
    position, has_gauss = state["numpy_position"].tolist()
    key = state["numpy"].numpy().astype(np.uint32)
    cached = state["numpy_gauss"].item()
    np.random.set_state(("MT19937", key, position, has_gauss, cached))
    torch.set_rng_state(state["torch"].clone())
    if "cuda" in state and torch.cuda.is_available():
        torch.cuda.set_rng_state(state["cuda"].clone())
