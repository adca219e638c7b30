"""Progress of a training run, and ``trainer.json``, which keeps it in a checkpoint."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from fluxvla_core.bounds import Count
from fluxvla_core.training.batches import Cursor


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
