"""torch's learning rate scheduler that follows a schedule of ``schedule.py``."""

from __future__ import annotations

from typing import Any

import torch

from fluxvla_core.training.schedule import Schedule


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
