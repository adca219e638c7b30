"""gym-aloha's cube scene, ``gym_aloha/AlohaTransferCube-v0``, and its two tasks.

Both tasks start from the same scene, so that the instruction alone decides what is right. Success
of both is determined in every episode: a policy that gets the other instruction should do the other
task, and that can be counted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fluxvla_sim.aloha.arms import TABLE, TwoArms

if TYPE_CHECKING:
    import numpy.typing as npt

MAX_STEPS = 300
"""Control steps in an episode: gym-aloha's limit, six seconds."""

LIFTED_M = 0.10
"""Height of the cube's centre that counts as lifted; it rests at about 0.02 on the table."""
CUBE_LOW, CUBE_HIGH = (0.0, 0.4, 0.05), (0.2, 0.6, 0.05)  # metres, world frame
_CUBE = "red_box"


def sample_cube(seed: int) -> npt.NDArray[np.float64]:
    """The cube's pose at the start, ``(7,)``: position in metres, quaternion wxyz."""
    position = np.random.RandomState(seed).uniform(CUBE_LOW, CUBE_HIGH)
    return np.concatenate([position, [1.0, 0.0, 0.0, 0.0]])


class AlohaScene(TwoArms):
    """The arms and one cube on the right arm's side."""

    file = "bimanual_viperx_transfer_cube.xml"

    def reset(self, seed: int) -> None:
        self.reset_to(sample_cube(seed))

    @property
    def cube(self) -> npt.NDArray[np.float64]:
        """``(7,)`` the cube's pose."""
        return self.objects

    def fingers_on_cube(self, arm: str) -> tuple[bool, bool]:
        """Which of ``arm``'s two fingers (left, right) touch the cube."""
        touching = self.touching(_CUBE)
        left, right = self.fingers[arm]
        return left in touching, right in touching

    def reward(self) -> int:
        """gym-aloha's reward: 1 right gripper touches, 2 lifted, 3 left touches, 4 handed over.

        As there, one named finger of each arm stands for its gripper.
        """
        touching = self.touching(_CUBE)
        on_table = self.geom[TABLE] in touching
        if self.fingers["left"][0] in touching:
            return 3 if on_table else 4
        if self.fingers["right"][1] in touching:
            return 1 if on_table else 2
        return 0


@dataclass(frozen=True)
class Facts:
    """See :class:`fluxvla_sim.world.Facts`; the rewards are gym-aloha's.

    Args:
        steps: control steps taken.
        reward: gym-aloha's, of the last step; ``best_reward`` the highest of any.
        left_touched: whether a finger of the left arm ever touched the cube.
        right_touches: whether a finger of the right arm touches the cube now.
        height: of the cube's centre now, in metres.
    """

    steps: int = 0
    reward: int = 0
    best_reward: int = 0
    left_touched: bool = False
    right_touches: bool = False
    height: float = 0.0

    def after(self, scene: AlohaScene) -> Facts:
        """The facts after one more control step of ``scene``."""
        reward = scene.reward()
        return Facts(
            steps=self.steps + 1,
            reward=reward,
            best_reward=max(self.best_reward, reward),
            left_touched=self.left_touched or any(scene.fingers_on_cube("left")),
            right_touches=any(scene.fingers_on_cube("right")),
            height=float(scene.cube[2]),
        )


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
