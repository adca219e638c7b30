"""What an instruction asks for, and how to tell whether it was done.

Both tasks start from the same scene, so that the instruction alone decides what is right. Success
of both is judged in every episode: a policy that hears the wrong instruction should do the other
task, and that can be counted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from fluxvla_core.errors import ConfigError
from fluxvla_sim.aloha.scene import AlohaScene

MAX_STEPS = 300
"""Control steps in an episode: gym-aloha's limit, six seconds."""

LIFTED_M = 0.10
"""Height of the cube's centre that counts as lifted; it rests at about 0.02 on the table."""


@dataclass(frozen=True)
class Facts:
    """What has happened in an episode so far, all that success is judged by.

    Args:
        steps: control steps taken.
        best_reward: the highest gym-aloha reward of any step.
        left_touched: whether a finger of the left arm ever touched the cube.
        right_touches: whether a finger of the right arm touches the cube now.
        height: of the cube's centre now, in metres.
    """

    steps: int = 0
    best_reward: int = 0
    left_touched: bool = False
    right_touches: bool = False
    height: float = 0.0

    def after(self, scene: AlohaScene) -> Facts:
        """The facts after one more control step of ``scene``."""
        return Facts(
            steps=self.steps + 1,
            best_reward=max(self.best_reward, scene.reward()),
            left_touched=self.left_touched or any(scene.fingers_on_cube("left")),
            right_touches=any(scene.fingers_on_cube("right")),
            height=float(scene.cube[2]),
        )


class Task(Protocol):
    """One instruction and its success."""

    name: str
    instruction: str
    record_steps: int

    def success(self, facts: Facts) -> bool:
        """Whether the task was done; once true it stays so, and the episode can end."""

    def done(self, facts: Facts) -> bool:
        """Whether nothing that comes could change :meth:`success`."""


class TransferCube:
    """gym-aloha's task: the left arm holds the cube in the air (reward 4), at any moment."""

    name = "transfer_cube"
    instruction = "hand the cube over to the left arm"
    record_steps = 250

    def success(self, facts: Facts) -> bool:
        return facts.best_reward == 4

    def done(self, facts: Facts) -> bool:
        return self.success(facts)


class LiftHold:
    """The right arm holds the cube in the air at step 300, and the left one never touched it.

    One finger's contact is enough: the solver drops one of a firm grip's two for single steps, and
    nothing else could keep the cube up there.
    """

    name = "lift_hold"
    instruction = "pick up the cube with the right arm and hold it"
    record_steps = 200

    def success(self, facts: Facts) -> bool:
        held = facts.right_touches and facts.height > LIFTED_M
        return held and not facts.left_touched and self.done(facts)

    def done(self, facts: Facts) -> bool:
        return facts.steps >= MAX_STEPS


TASKS: dict[str, Task] = {task.name: task for task in (TransferCube(), LiftHold())}


def get_task(name: str) -> Task:
    """The task called ``name``.

    Raises:
        ConfigError: there is none; the message lists those that are.
    """
    if name not in TASKS:
        raise ConfigError(f"there is no task {name!r}; there are {', '.join(TASKS)}")
    return TASKS[name]


def task_of(instruction: str) -> Task | None:
    """The task that an instruction in these words asks for; None if none does."""
    words = instruction.casefold().split()
    return next((t for t in TASKS.values() if t.instruction.casefold().split() == words), None)
