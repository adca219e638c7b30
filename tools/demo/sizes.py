"""Sizes of the forms of the demo."""

from __future__ import annotations

from collections.abc import Mapping
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
        overrides: of the config, in addition to those above.
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


def affordable_steps(size: Size, step_s: float, elapsed_s: float, pace: float = 1.0) -> int:
    """The steps that fit into the limit.

    Args:
        step_s: seconds that one step was measured to take.
        elapsed_s: seconds that the demo has taken so far.
        pace: how many times longer than expected the stages took so far; so will those after
            the training.
    """
    if size.minutes is None:
        return size.steps
    around = (AFTER_TRAINING_S + AROUND_STEPS_S) * max(1.0, pace)
    left = size.minutes * 60 - elapsed_s - around
    return max(size.fewest_steps, min(size.steps, int(left / step_s)))


STEP_S = 0.55
"""Seconds of a training step on two free cores; ``measure`` finds this machine's."""


def expected_s(size: Size, steps: int | None = None, step_s: float = STEP_S) -> dict[str, float]:
    """Seconds that each stage takes on two free cores, in the order of the stages.

    Args:
        steps: of the training; unknown before the speed is measured: as many as fit, or those of
            the size.
        step_s: seconds of one step.
    """
    collect = {"collect": 5.0 + 0.8 * size.demonstrations}
    measure = {} if size.minutes is None else {"measure": 20.0}
    # Two tasks; the trained policy, the other instruction, and an untrained one.
    evaluate = 20.0 + 1.4 * 2 * 3 * size.episodes
    after = {"evaluate": evaluate, "robot 1": 10.0, "robot 2": 10.0, "report": 2.0}
    if steps is None:
        before = sum((*collect.values(), *measure.values()))
        steps = affordable_steps(size, step_s, before)
    return {**collect, **measure, "train": AROUND_STEPS_S + steps * step_s, **after}


def left_s(expected: Mapping[str, float], took: Mapping[str, float]) -> float:
    """Seconds that the stages which are not in ``took`` still take.

    A machine that was slower than expected so far, or faster, is expected to stay so.
    """
    so_far = sum(expected[name] for name in took if name in expected)
    pace = sum(took[name] for name in took if name in expected) / so_far if so_far else 1.0
    return pace * sum(seconds for name, seconds in expected.items() if name not in took)
