"""Seeds, the state of all random generators, and the progress of a training run."""

from __future__ import annotations

import random
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from fluxvla_core.bounds import Count
from fluxvla_core.contracts.training import Dataset
from fluxvla_core.data.sampler import order_rng
from fluxvla_core.training.batches import Cursor


def seed_all(seed: int) -> None:
    """Seed python, numpy, torch and, where there is one, the GPU."""
    random.seed(seed)
    np.random.seed(seed % 2**32)
    torch.manual_seed(seed)


def take_seed(dataset: Any, seed: int) -> None:
    """Let ``dataset`` draw by ``seed``, unless it has one of its own or knows of none."""
    Dataset.adapt(dataset).use_seed(seed)


def seeds_of(dataset: Any) -> list[int | None]:
    """What ``dataset`` draws by, followed by the datasets that it is made of; None if unknown."""
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


@dataclass(frozen=True)
class SavedCursor:
    """The next sample."""

    epoch: Count
    samples: Count


@dataclass(frozen=True)
class SavedValidation:
    """How validation went; absent where there was none."""

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
    """What advances from step to step, and what a checkpoint's ``trainer.json`` says of it.

    Args:
        step: optimizer steps done.
        cursor: the next sample.
        loss: mean loss of the last step that was fetched.
        saved: the step of the last checkpoint, -1 when there is none.
        best, best_step: lowest validation loss, and its step.
        worse: validations since then.
        unvalidated: the record of the present step, which a stop left without its validation.
    """

    step: int = 0
    cursor: Cursor = field(default_factory=Cursor)
    loss: float | None = None
    saved: int = -1
    best: float | None = None
    best_step: int = -1
    worse: int = 0
    unvalidated: dict[str, Any] | None = None

    def validated(self, loss: float) -> bool:
        """Take the validation loss of the present step; whether it is the best so far."""
        if self.best is None or loss < self.best:
            self.best, self.best_step, self.worse = loss, self.step, 0
            return True
        self.worse += 1
        return False

    def to_dict(self) -> dict[str, Any]:
        """JSON values; :meth:`from_dict` is the inverse."""
        return {
            "global_step": self.step,
            "epoch": self.cursor.epoch,
            "cursor": {"epoch": self.cursor.epoch, "samples": self.cursor.samples},
            "train_loss": self.loss,
            "validation": {
                "best": self.best,
                "best_step": self.best_step,
                "worse": self.worse,
                **({"owed": self.unvalidated} if self.unvalidated is not None else {}),
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
            worse=validation.get("worse", 0),
            unvalidated=validation.get("owed"),
        )
