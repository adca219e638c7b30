"""How an episode stands, as a simulated robot tells those who ask on ``/sim/facts``."""

from __future__ import annotations

from typing import Any

from fluxvla_sim.world import Scene, World


class Judge:
    """Keeps the facts of one episode after the other, and judges every task of the world.

    An episode's steps begin with its first command, as in an evaluation: until then nothing can
    have been done. After the world's ``max_steps`` its outcome is settled.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        self._facts = world.begin()
        self._seed = 0
        self._resets = 0

    def reset(self, seed: int) -> None:
        """An episode begins."""
        self._facts = self._world.begin()
        self._seed = seed
        self._resets += 1

    def after(self, scene: Scene) -> None:
        """One more control period has passed since the first command."""
        if self._facts.steps < self._world.max_steps:
            self._facts = self._facts.after(scene)

    def tell(self) -> dict[str, Any]:
        """JSON values: ``seed``, ``resets`` (how many episodes began), ``steps`` and ``tasks``:
        name -> ``instruction``, ``success``, ``done``."""
        tasks = {
            task.name: {
                "instruction": task.instruction,
                "success": task.success(self._facts),
                "done": task.done(self._facts) or self._facts.steps >= self._world.max_steps,
            }
            for task in self._world.tasks
        }
        steps = self._facts.steps
        return {"seed": self._seed, "resets": self._resets, "steps": steps, "tasks": tasks}
