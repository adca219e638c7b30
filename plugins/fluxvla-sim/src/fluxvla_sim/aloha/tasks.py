"""The two tasks of the cube scene, and how to tell whether they were done.

Both start from the same scene, so that the instruction alone decides what is right. Success
of both is judged in every episode: a policy that hears the wrong instruction should do the other
task, and that can be counted.
"""

from __future__ import annotations

from dataclasses import dataclass

from fluxvla_sim.aloha.scene import AlohaScene

MAX_STEPS = 300
"""Control steps in an episode: gym-aloha's limit, six seconds."""

LIFTED_M = 0.10
"""Height of the cube's centre that counts as lifted; it rests at about 0.02 on the table."""


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
