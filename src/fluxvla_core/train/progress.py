"""Where a training run stands."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from fluxvla_core.train.batches import Cursor


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
        owed: the record of the present step, which a stop left without its validation.
    """

    step: int = 0
    cursor: Cursor = field(default_factory=Cursor)
    loss: float | None = None
    saved: int = -1
    best: float | None = None
    best_step: int = -1
    worse: int = 0
    owed: dict[str, Any] | None = None

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
                **({"owed": self.owed} if self.owed is not None else {}),
            },
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Progress:
        """The progress that a checkpoint was saved with."""
        cursor = Cursor(data["cursor"]["epoch"], data["cursor"]["samples"])
        step = data["global_step"]
        validation = data.get("validation", {})
        return cls(step, cursor, data["train_loss"], step, **validation)
