"""``SimExpert``: the scripted experts of all simulated robots as one policy."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import ConfigError
from fluxvla_core.models import Policy
from fluxvla_sim.world import CONTROL_HZ, Expert, Scene, SimRobot, SimWorld, task_of

if TYPE_CHECKING:
    from fluxvla_core.models import Observation
    from fluxvla_core.operators import EmbodimentSpec

Array = npt.NDArray[np.float64]


class Place(Protocol):
    """The simulation an expert acts in: a ``SimEnvironment``, or a connected ``SimOperator``."""

    robot: SimRobot
    world: SimWorld

    @property
    def scene(self) -> Scene: ...


class SimExpert(Policy):
    """Keyframes of a script that sees where the objects truly are.

    Its success through the whole pipeline (keyframes, interpolation, limits) is an upper bound for
    any policy, and a check of the pipeline.

    Args:
        action_rate_hz: keyframes a second; must divide 50.
        horizon: keyframes in a chunk.
        noise: standard deviation, in rad, of smooth offsets on what a demonstration executes:
            ``executed``, the plan at every control step. Its labels, the keyframes, are without
            them, so that they lead back to the expert's way (Laskey et al., "DART", CoRL 2017).

    Raises:
        ConfigError: a value is impossible.
    """

    api: ClassVar[str] = "1.0"
    cameras: ClassVar[tuple[str, ...]] = ()

    def __init__(self, action_rate_hz: float = 10.0, horizon: int = 20, noise: float = 0.0) -> None:
        self._stride = frame_stride(action_rate_hz)
        if horizon < 1:
            raise ConfigError(f"horizon must be at least 1, got {horizon}")
        if not 0 <= noise <= 0.2:
            raise ConfigError(f"noise must be from 0 to 0.2 rad, got {noise}")
        self.action_rate_hz = action_rate_hz
        self.horizon = horizon
        self.noise = noise
        self.executed: Array | None = None
        self._place: Place | None = None
        self._experts: dict[int, Expert] = {}
        self._seed = 0
        self._plan: Array | None = None
        self._way: Array = np.zeros((0, 0))

    @property
    def embodiment(self) -> EmbodimentSpec | None:
        """The embodiment of the robot that it acts with; None before ``enter``."""
        return None if self._place is None else self._place.robot.embodiment(())

    def enter(self, environment: Any) -> None:
        """Set where it acts; it reads the scene when it plans an episode's first chunk.

        Raises:
            ConfigError: that is not a simulated robot of this plugin.
        """
        if not isinstance(getattr(environment, "robot", None), SimRobot):
            raise ConfigError(
                f"SimExpert knows its way in AlohaSimEnvironment and URSimEnvironment only, not in "
                f"{type(environment).__name__}"
            )
        self._place = environment

    def reset(self, seed: int) -> None:
        """Begin an episode; the noise follows from ``seed``."""
        self._seed, self._plan, self.executed = seed, None, None

    def predict_action(self, observation: Observation) -> Array:
        """``(horizon, D)`` keyframes from the present step on; the last one holds at the end.

        Raises:
            ConfigError: it has not entered anything, or does not know the instruction.
        """
        if self._place is None:
            raise ConfigError("SimExpert does not know where it is", next="call enter() first")
        if self._plan is None:
            self._plan = self._planned(self._place, observation["task_description"])
        plan, step = self._plan, self._place.scene.steps
        self.executed = self._way[step : step + self._stride]
        steps = step + self._stride * (1 + np.arange(self.horizon)) - 1
        return plan[np.minimum(steps, len(plan) - 1)]

    def _planned(self, place: Place, instruction: str) -> Array:
        world, scene = place.world, place.scene
        task = task_of(world, instruction)
        if task is None:
            raise ConfigError(
                f"the expert does not know {instruction!r}",
                next="ask for one of the tasks' own instructions",
            )
        key = id(scene)
        if key not in self._experts:
            self._experts[key] = world.open_expert(scene.model)
        plan = self._experts[key].plan(task.name, scene.objects)
        rng = np.random.default_rng(self._seed)
        self._way = plan + self.noise * world.noise(rng) if self.noise else plan
        return plan


def frame_stride(fps: float) -> int:
    """Control steps from frame to frame.

    Raises:
        ConfigError: ``fps`` does not divide 50.
    """
    stride = round(CONTROL_HZ / fps) if fps > 0 else 0
    if stride < 1 or stride * fps != CONTROL_HZ:
        raise ConfigError(f"{fps:g} frames a second do not divide {CONTROL_HZ:g} control steps")
    return stride
