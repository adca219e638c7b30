"""How large each form of the demo is."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Size:
    """One form of the demo.

    Args:
        name: also the folder's.
        demonstrations: episodes to collect, of both tasks in turn.
        steps: optimizer steps, at most.
        fewest_steps: and at least, however slow the machine.
        minutes: what the whole demo may take, installation included; None: no limit. With a
            limit the steps are chosen by the speed that is measured first.
        episodes: to evaluate, for each task and each way of acting.
        overrides: of the config, beside those above.
    """

    name: str
    demonstrations: int
    steps: int
    fewest_steps: int
    minutes: float | None
    episodes: int
    overrides: tuple[str, ...] = ()


SIZES = {
    "smoke": Size("smoke", 8, 12, 12, None, 1, ("train_dataloader.per_device_batch_size=8",)),
    "default": Size("default", 240, 1500, 300, 19.0, 25),
    "full": Size("full", 480, 3000, 3000, None, 100),
}

# What has to follow the training within the limit: evaluation, two episodes, the report.
AFTER_TRAINING_S = 270.0
# Reading the data, starting processes and writing the checkpoint belong to training, too.
AROUND_STEPS_S = 30.0


def affordable_steps(size: Size, step_s: float, elapsed_s: float) -> int:
    """The steps that fit into the limit.

    Args:
        step_s: seconds that one step was measured to take.
        elapsed_s: seconds that the demo has taken so far.
    """
    if size.minutes is None:
        return size.steps
    left = size.minutes * 60 - elapsed_s - AFTER_TRAINING_S - AROUND_STEPS_S
    return max(size.fewest_steps, min(size.steps, int(left / step_s)))
