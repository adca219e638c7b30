"""An environment in which a point is pushed left or right, and policies: for EvalRunnerConformance.

Loaded as a plugin file, so that worker processes load it too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.environment import Environment, EnvironmentSpec, Step, TaskSpec
from fluxvla_core.contracts.frame import Observation
from fluxvla_core.contracts.policy import Actor
from fluxvla_core.plugins.registry import ENVIRONMENTS, POLICIES
from fluxvla_core.spec import Camera, EmbodimentSpec, Joint

SIDES = {"left": -1.0, "right": 1.0}
_STEPS, _STRIDE = 12, 0.1
_BODY = EmbodimentSpec(
    "a point",
    (Joint("x", "m", -0.2, 0.2, 2.0, 20.0, "prismatic"),),
    (Camera("above", 8, 16),),
    10.0,
    "delta",
    "world",
)
_TASKS = tuple(TaskSpec(side, f"push it to the {side}", max_steps=_STEPS) for side in SIDES)


@ENVIRONMENTS.register_module()
class KitPush(Environment):
    """Push the point to one of the sides; it begins near the middle, by the seed."""

    api: ClassVar[str] = "1.0"
    expert: ClassVar[str | None] = "KitListener"

    def __init__(self) -> None:
        self._task, self._place = _TASKS[0], 0.0

    @property
    def spec(self) -> EnvironmentSpec:
        return EnvironmentSpec("pushing", _BODY, _TASKS, limited=False)

    @property
    def state(self) -> npt.NDArray[np.float64]:
        return np.array([self._place])

    def reset(self, seed: int, task: str) -> None:
        self._task = self.spec.task(task)
        self._place = float(np.random.default_rng(seed).uniform(-0.05, 0.05))

    def step(self, action: npt.NDArray[np.float64]) -> Step:
        self._place += float(np.clip(action[0], -_STRIDE, _STRIDE))
        done = self._place * SIDES[self._task.name] >= 0.5
        return Step(reward=-abs(self._place - SIDES[self._task.name]), success=done, ended=done)

    def observe(self, cameras: Sequence[Camera]) -> Observation:
        shade = int(np.clip(128 + 100 * self._place, 0, 255))
        return {
            "qpos": self.state.astype(np.float32),
            "images": {c.name: np.full((c.height, c.width, 3), shade, np.uint8) for c in cameras},
            "task_description": self._task.instruction,
        }

    def close(self) -> None:
        """Nothing is open."""


class _Pusher(Actor):
    """Pushes by ``way`` in each step."""

    api: ClassVar[str] = "1.0"
    cameras: tuple[str, ...] = ()

    def __init__(self) -> None:
        self.way = 0.0

    def reset(self, seed: int) -> None:
        """Nothing in it is random."""

    def predict_action(self, observation: Observation) -> npt.NDArray[np.float64]:
        return np.full((2, 1), self.way * _STRIDE)


@POLICIES.register_module()
class KitListener(_Pusher):
    """Follows the instruction, and so succeeds at every task."""

    def predict_action(self, observation: Observation) -> npt.NDArray[np.float64]:
        said = observation["task_description"]
        self.way = next((way for side, way in SIDES.items() if said.endswith(side)), 0.0)
        return super().predict_action(observation)


@POLICIES.register_module()
class KitGuesser(_Pusher):
    """Goes to a side that follows from the seed: right in about half of the episodes."""

    def reset(self, seed: int) -> None:
        self.way = float(np.random.default_rng(seed + 1000).choice([-1.0, 1.0]))


@POLICIES.register_module()
class KitIdler(_Pusher):
    """Does nothing, and never succeeds."""


@POLICIES.register_module()
class KitBroken(_Pusher):
    """Cannot answer."""

    def predict_action(self, observation: Observation) -> npt.NDArray[np.float64]:
        raise ValueError("this policy cannot answer")
