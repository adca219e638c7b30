"""Worlds of simulated robots: scenes with their tasks and scripted experts.

A ``SimWorld`` is one scene with its tasks and its scripted expert, a ``SimRobot`` is a robot with
the worlds that it can be put into. Everything else (operators, evaluation, collection, ROS 2 nodes)
is written against these two, once for all robots. Naming them loads neither MuJoCo nor a model
file.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from fluxvla_core.errors import ConfigError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from fluxvla_core.operators import Camera, EmbodimentSpec

    Array = npt.NDArray[np.float64]

CONTROL_HZ = 50.0
"""Commands a second of every simulated robot: a control period is 20 ms."""
SUBSTEPS = 10
"""Steps of the physics in a control period."""


class Scene(Protocol):
    """A robot among its objects; one :meth:`step` is one control period.

    ``model`` and ``data`` are MuJoCo's; ``steps`` counts the commands since the last reset.
    """

    model: Any
    data: Any
    steps: int

    def reset(self, seed: int) -> None:
        """Robot at home, objects where ``seed`` puts them."""

    def step(self, action: Array) -> None:
        """Drive to the joint targets ``(D,)`` for one control period."""

    def advance(self, action: Array, substeps: int) -> None:
        """Drive to ``(D,)`` for so many steps of the physics; ``SUBSTEPS`` make a period."""

    @property
    def state(self) -> Array:
        """``(D,)`` joint positions, in the embodiment's units."""

    @property
    def objects(self) -> Array:
        """``(7 n,)`` the true poses of what can be moved: metres in the world frame, wxyz."""

    def render(self, camera: str, height: int, width: int) -> npt.NDArray[np.uint8]:
        """A new ``(height, width, 3)`` uint8 RGB image."""

    def close(self) -> None:
        """Free the renderer; any number of times."""


class Facts(Protocol):
    """Events of an episode so far: everything that success depends on.

    ``steps`` were taken, the last one with ``reward``.
    """

    steps: int
    reward: int

    def after(self, scene: Any) -> Facts:
        """The facts after one more control period of ``scene``."""


class Task(Protocol):
    """One instruction and its success.

    ``record_steps`` is how much of the expert's episode a demonstration shows.
    """

    name: str
    instruction: str
    record_steps: int

    def success(self, facts: Any) -> bool:
        """Whether the task was done; once true it stays so, and the episode can end."""

    def done(self, facts: Any) -> bool:
        """Whether nothing that comes could change :meth:`success`."""


class Expert(Protocol):
    """A script that knows where everything is."""

    def plan(self, task: str, objects: Array) -> Array:
        """``(max_steps, D)`` joint targets for an episode that begins with ``objects``."""


@dataclass(frozen=True)
class SimWorld:
    """One scene, its tasks and its expert.

    Args:
        tasks: all start from the same scenes, so that the instruction alone says what is right.
        max_steps: control steps in an episode.
        open_scene: from the images' quality to a scene.
        open_expert: from the scene's model to an expert.
        begin: the facts before the first step.
        noise: from a generator to ``(max_steps, D)`` offsets of about unit size, in rad, that
            disturb an expert without asking for what no arm can do.
    """

    tasks: tuple[Task, ...]
    max_steps: int
    open_scene: Callable[[str], Scene]
    open_expert: Callable[[Any], Expert]
    begin: Callable[[], Facts]
    noise: Callable[[np.random.Generator], Array]


@dataclass(frozen=True)
class SimRobot:
    """A robot that is simulated.

    Args:
        name: as commands take it.
        title: as displayed.
        cameras: of every one of its worlds.
        embodiment: its spec with the cameras that are given, at ``CONTROL_HZ``.
        worlds: what it can be put into.
        default_tasks: what is evaluated and demonstrated if nothing else is said.
    """

    name: str
    title: str
    cameras: tuple[str, ...]
    embodiment: Callable[[Sequence[Camera]], EmbodimentSpec]
    worlds: tuple[SimWorld, ...]
    default_tasks: tuple[str, ...]

    @property
    def task_names(self) -> tuple[str, ...]:
        """The tasks of all worlds."""
        return tuple(task.name for world in self.worlds for task in world.tasks)

    def find(self, name: str) -> tuple[SimWorld, Task]:
        """The task called ``name``, and its world.

        Raises:
            ConfigError: there is none; the message lists those that are.
        """
        for world in self.worlds:
            for task in world.tasks:
                if task.name == name:
                    return world, task
        raise ConfigError(f"there is no task {name!r}; there are {', '.join(self.task_names)}")


def task_of(world: SimWorld, instruction: str) -> Task | None:
    """The task of ``world`` that an instruction in these words asks for; None if none does."""
    words = instruction.casefold().split()
    return next((t for t in world.tasks if t.instruction.casefold().split() == words), None)
