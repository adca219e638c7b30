"""Any simulator behind a small contract, so that one engine evaluates and collects in all of them.

An environment's constructor is light: what ``spec`` says is known before a scene is built, which
the first ``reset`` does. Everything random in an episode follows from its seed; then its outcome
depends neither on the process that ran it nor on the episodes before it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from fluxvla_core.contracts.frame import Observation
from fluxvla_core.spec.embodiment import Camera, EmbodimentSpec

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt


@dataclass(frozen=True)
class TaskSpec:
    """One thing to be done.

    Args:
        name: unique in its environment; used in file names and as a key.
        instruction: what a policy is told.
        max_steps: control steps after which an episode ends.
        record_steps: how many of a demonstration's steps teach something; all by default.
    """

    name: str
    instruction: str
    max_steps: int
    record_steps: int | None = None


@dataclass(frozen=True)
class EnvironmentSpec:
    """What is known of an environment before anything is built.

    Args:
        name: for people and reports.
        embodiment: what actions and states mean, control steps a second (``rate_hz``), and the
            cameras with their usual sizes.
        tasks: at least one.
        limited: actions are joint targets that take the way of a robot's commands: keyframes are
            joined at ``rate_hz`` and kept within the embodiment's limits. Otherwise each action of
            a chunk is one step.
        keep_together: going from one task to another takes seconds, so that episodes of one task
            are best run one after the other.
        details: what else a report should state: how pictures are drawn, versions.
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


@dataclass(frozen=True)
class Step:
    """What came of one action.

    Args:
        reward: of this step.
        success: whether the task of the scene is done, now or at any moment before.
        ended: whether the episode ends here; a success need not end it.
        behaviours: the success of every task that can be judged in this scene, by name.
    """

    reward: float
    success: bool
    ended: bool
    behaviours: Mapping[str, bool] | None = None


class Environment(Protocol):
    """Tasks to be done, in the process that made it.

    It may have ``state_hash() -> str``, equal for equal courses of an episode (the states of all
    steps are hashed where there is none), and what :class:`Retellable` adds.
    """

    @property
    def spec(self) -> EnvironmentSpec: ...

    @property
    def state(self) -> npt.NDArray[np.float64]:
        """``(state_dim,)`` now; what ``observe`` gives as ``qpos`` is this, rounded."""

    def reset(self, seed: int, task: str) -> None:
        """Begin an episode of ``task``; everything random in it follows from ``seed``."""

    def step(self, action: npt.NDArray[np.float64]) -> Step:
        """One control step with an action ``(dim,)`` in the embodiment's units."""

    def observe(self, cameras: Sequence[Camera]) -> Observation:
        """What is there now, with a picture of each camera, in its size where that can be had.

        Called when somebody looks, not after every step: drawing is what takes the time.
        """

    def close(self) -> None:
        """Give everything back; any number of times."""


class Retellable(Environment, Protocol):
    """An environment in whose scenes something else could be asked for, too."""

    def others(self, task: str) -> Sequence[str]:
        """Tasks that could also be done in the scene of ``task``; none of them is it."""

    def tell(self, task: str) -> None:
        """After ``reset``: the policy is told the instruction of ``task`` in this episode, which
        ends when that is done, too. ``success`` stays that of the scene's own task."""


class Actor(Protocol):
    """What an environment needs of a policy.

    The Policy contract's ``embodiment``, ``cameras`` and ``action_rate_hz`` are checked and used
    where they are there. With ``enter(environment)`` a policy is told where it acts: that is how
    scripted experts see what others must look for. After ``predict_action``, ``executed`` may hold
    ``(N, dim)`` commands that lead to the chunk's first action in other words than a straight
    line: what a demonstrator does, which may be noisier than what it means.
    """

    def reset(self, seed: int) -> None:
        """Begin an episode; everything random in it follows from ``seed``."""

    def predict_action(self, observation: Observation) -> npt.NDArray[np.float64]:
        """``(T, dim)``: the next T actions."""
