"""Evaluation runners of the simulated robots."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

from fluxvla_core.errors import ConfigError
from fluxvla_core.evaluation import EvalRunner
from fluxvla_sim.aloha.world import ALOHA
from fluxvla_sim.ur import UR5E
from fluxvla_sim.world import SimRobot


class SimEvalRunner(EvalRunner):
    """``EvalRunner`` in the environment that a subclass names.

    Args:
        tasks: names of the tasks; the robot's usual ones by default.
        episodes: for each task.
        seed: of each task's first episode; the others count up from it.
        swap_seed: of the first episode with the other task's instruction; by default these repeat
            the policy's own seeds, so that right and wrong instructions are compared pair by pair.
        replan_every: how many actions of a chunk are executed before the policy is queried again.
        max_steps: control steps (20 ms) after which an episode ends, if later than by itself.
        render: ``cheap``, ``coarse`` or ``reference`` images, see ``SimEnvironment``.
        video_height, video_width, video_fps: of the videos.
        **kwargs: as ``EvalRunner`` takes them.

    Raises:
        ConfigError: a value is impossible.
    """

    environment: ClassVar[str]
    robot: ClassVar[SimRobot]

    def __init__(
        self,
        tasks: Sequence[str] | None = None,
        episodes: int = 50,
        seed: int = 500,
        swap_seed: int | None = None,
        replan_every: int = 5,
        max_steps: int | None = None,
        render: str = "cheap",
        video_height: int = 240,
        video_width: int = 320,
        video_fps: float = 25.0,
        **kwargs: Any,
    ) -> None:
        if "environment" in kwargs:
            raise ConfigError(
                f"{type(self).__name__} is for {self.environment} alone",
                next="for another environment use type='EvalRunner'",
            )
        names = self.robot.default_tasks if tasks is None else tuple(tasks)
        super().__init__(
            environment={"type": self.environment, "render": render},
            tasks=names,
            episodes=episodes,
            seed=seed,
            swap_seed=swap_seed,
            replan_every=replan_every,
            max_steps=max_steps,
            video_height=video_height,
            video_width=video_width,
            video_fps=video_fps,
            **kwargs,
        )
        least = max(self.robot.find(name)[0].max_steps for name in names) if names else 0
        if max_steps is not None and max_steps < least:
            raise self.config_error("max_steps", f"must be at least {least}, got {max_steps}")


class AlohaSimEvalRunner(SimEvalRunner):
    """On gym-aloha's scenes: ``lift_hold``, ``transfer_cube`` and ``insertion``."""

    environment: ClassVar[str] = "AlohaSimEnvironment"
    robot: ClassVar[SimRobot] = ALOHA


class URSimEvalRunner(SimEvalRunner):
    """On the UR5e at its table: ``lift_cube``."""

    environment: ClassVar[str] = "URSimEnvironment"
    robot: ClassVar[SimRobot] = UR5E
