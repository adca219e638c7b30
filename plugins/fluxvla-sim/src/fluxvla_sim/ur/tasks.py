"""What the UR5e is asked for, and how to tell whether it was done."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fluxvla_sim.ur.scene import URScene

MAX_STEPS = 300
"""Control steps in an episode: six seconds."""

_HELD_STEPS = 10


@dataclass(frozen=True)
class LiftFacts:
    """See :class:`fluxvla_sim.world.Facts`; the reward is 1 while the cube is held in the air.

    ``held`` is for how many steps on end it has been held; ``longest`` the most ever.
    """

    steps: int = 0
    reward: int = 0
    held: int = 0
    longest: int = 0

    def after(self, scene: URScene) -> LiftFacts:
        """The facts after one more control step of ``scene``."""
        held = self.held + 1 if scene.lifted() else 0
        return LiftFacts(self.steps + 1, int(held > 0), held, max(self.longest, held))


class LiftCube:
    """The fingers hold the cube in the air for 0.2 s: a toss, or a bounce, is no grasp."""

    name = "lift_cube"
    instruction = "pick up the red cube"
    record_steps = 260

    def success(self, facts: LiftFacts) -> bool:
        return facts.longest >= _HELD_STEPS

    def done(self, facts: LiftFacts) -> bool:
        return self.success(facts)
