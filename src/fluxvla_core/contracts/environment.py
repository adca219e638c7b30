"""The contract of environments: simulators in which policies are evaluated and data is collected.

An environment's constructor is light: ``spec`` is known before the first ``reset`` builds a scene.
Everything random in an episode follows from its seed, so that its outcome depends neither on the
process that ran it nor on the episodes before it.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

from fluxvla_core.contracts.contract import Contract, attribute, required
from fluxvla_core.contracts.frame import Observation
from fluxvla_core.errors import ConfigError
from fluxvla_core.spec import Camera, EmbodimentSpec

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt


@dataclass(frozen=True)
class TaskSpec:
    """One task of an environment.

    Args:
        name: unique in its environment; used in file names and as a key.
        instruction: the language instruction that a policy gets.
        max_steps: control steps after which an episode ends.
        record_steps: how many steps of a demonstration to record; all by default.
    """

    name: str
    instruction: str
    max_steps: int
    record_steps: int | None = None


@dataclass(frozen=True)
class EnvironmentSpec:
    """Description of an environment: tasks, cameras, embodiment; known before anything is built.

    Args:
        name: for people and reports.
        embodiment: what actions and states mean, control steps a second (``rate_hz``), and the
            cameras with their usual sizes.
        tasks: at least one.
        limited: actions are joint targets that are processed as a robot's commands are: joined at
            ``rate_hz`` and kept within the embodiment's limits. Otherwise each action of a chunk is
            one step.
        keep_together: changing the task takes seconds, so that episodes of one task are best run
            one after the other.
        details: further facts for reports: how images are rendered, versions.
    """

    name: str
    embodiment: EmbodimentSpec
    tasks: tuple[TaskSpec, ...]
    limited: bool = False
    keep_together: bool = False
    details: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        names = [task.name for task in self.tasks]
        if not names or len(set(names)) != len(names):
            raise ValueError(f"an environment has tasks, each with a name of its own; got {names}")
        if self.limited and self.embodiment.action_mode != "absolute":
            raise ValueError("limits can only be kept for absolute joint targets")

    def task(self, name: str) -> TaskSpec:
        """The task called ``name``, which is one of ``tasks``."""
        return next(task for task in self.tasks if task.name == name)

    def select_tasks(self, names: Sequence[str] | None) -> tuple[TaskSpec, ...]:
        """The tasks called ``names``, in their order; all of them for None.

        Raises:
            ConfigError: there is none of that name, or one is named twice.
        """
        if names is None:
            return self.tasks
        known = {task.name: task for task in self.tasks}
        for name in names:
            if name not in known:
                raise ConfigError(f"there is no task {name!r}; there are {', '.join(known)}")
        if not names or len(set(names)) != len(names):
            raise ConfigError(f"tasks must name each task once, got {list(names)}")
        return tuple(known[name] for name in names)


@dataclass(frozen=True)
class Step:
    """The result of one action.

    Args:
        reward: of this step.
        success: whether the task of the scene is done, now or at any moment before.
        ended: whether the episode ends here; a success need not end it.
        behaviours: the success of every task that can be checked in this scene, by name.
    """

    reward: float
    success: bool
    ended: bool
    behaviours: Mapping[str, bool] | None = None


class Environment(Contract):
    """A simulator with tasks, in the process that made it."""

    expert: ClassVar[str | None] = None
    """``type`` of the registered policy that solves its tasks: ``policy = "expert"`` in configs."""

    @required
    def spec(self) -> EnvironmentSpec:
        """Valid before anything is built."""

    @required
    def state(self) -> npt.NDArray[np.float64]:
        """``(state_dim,)`` now; what ``observe`` gives as ``qpos`` is this, rounded."""

    @abstractmethod
    def reset(self, seed: int, task: str) -> None:
        """Begin an episode of ``task``; everything random in it follows from ``seed``."""

    @abstractmethod
    def step(self, action: npt.NDArray[np.float64]) -> Step:
        """One control step with an action ``(dim,)`` in the embodiment's units."""

    @abstractmethod
    def observe(self, cameras: Sequence[Camera]) -> Observation:
        """The current observation, with an image of each camera, in its size if possible.

        ``task_description`` is the language instruction: the task's, or one of the environment's
        own for this episode.

        Called when the policy or a video needs it, not after every step: rendering is slow.
        """

    @abstractmethod
    def close(self) -> None:
        """Free all resources; may be called more than once."""

    # -- optional abilities ----------------------------------------------------------------------

    def divergence(self) -> str | None:
        """Why the simulation diverged since the last reset, None if it did not.

        Called after every step; a state that is not finite is noticed without it. For MuJoCo, whose
        simulations reset themselves, ``fluxvla_mujoco.divergence(data)`` answers it.
        """
        return None

    def drawn_by(self) -> str:
        """OpenGL backend and renderer of its images, for results; "" if unknown."""
        return ""

    @attribute
    def distributions(self) -> Sequence[str]:
        """Installed packages that influence outcomes, besides those that its plugin requires."""
        return ()

    def state_hash(self) -> str | None:
        """Equal for equal courses of an episode; None: the states of all steps are hashed."""
        return None

    def other_tasks(self, task: str) -> Sequence[str]:
        """Names of other tasks that could be done in the scene of ``task``."""
        return ()

    def set_instruction(self, task: str) -> None:
        """After ``reset``: give the policy the instruction of ``task``, one of ``other_tasks``, in
        this episode, which then also ends when that is done. ``success`` stays that of the scene's
        own task."""
        raise NotImplementedError(f"{type(self).__name__} has no scene with two tasks")
