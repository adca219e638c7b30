"""What an operator, a policy or an action filter may have besides what its contract asks for.

Each of these is used where it is there, and nothing is missing where it is not.
``contracts.check`` refuses a class whose method of such a name takes other arguments.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

from fluxvla_core.contracts.continuation import Continuation
from fluxvla_core.contracts.frame import Observation
from fluxvla_core.contracts.protocols import Clock
from fluxvla_core.spec.embodiment import EmbodimentSpec

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt


class HasClock(Protocol):
    """An operator with a time of its own: a simulation that steps its physics in ``send_action``.

    ``clock.lockstep`` (True by default) says whether that time stands still between commands. An
    operator without a clock, or whose ``clock`` is None, lives on the monotonic clock.
    """

    clock: Clock | None


class ReadsState(Protocol):
    """An operator that can be asked for its state alone, at no cost: it is, after each command."""

    def get_state(self) -> npt.NDArray[np.float64]:
        """The newest ``(state_dim,)`` state. Called from the thread that sends commands."""


class StampsState(Protocol):
    """An operator that knows how old what ``get_state`` gives may be: its joint states arrive.

    An arm whose joint states are old is not taken for one that does not follow.
    """

    def state_stamp(self) -> float:
        """When the newest state arrived, in seconds on the operator's clock."""


class TellsLastAction(Protocol):
    """An operator that knows what holds its arm, also after a stop: episodes begin from there.

    An arm lags behind what holds it, and a gripper presses: neither is to be let go. After a stop,
    a joint further from it than ``safety.trips.HOLD_REACH`` was moved, and begins where it is.
    """

    @property
    def last_action(self) -> npt.NDArray[np.float64] | None:
        """``(dim,)`` the command that the arm has: the last one, or what ``stop`` made of it.

        None if it has none, or one of somebody else's.
        """


class ScalesSpeed(Protocol):
    """An operator whose robot a person may slow down: commands keep to that share of its speed."""

    @property
    def speed_scaling(self) -> float:
        """0 (paused: ``send_action`` refuses) to 1."""


class KeepsPictures(Protocol):
    """An operator that keeps pictures for a while: recordings then have all that arrive."""

    def pictures_after(
        self, camera: str, after: float
    ) -> tuple[Sequence[tuple[float, npt.NDArray[np.uint8]]], int]:
        """Stamps and ``(H, W, 3)`` uint8 RGB pictures, oldest first, and how many ever arrived.

        Called often, from a thread of its own; ``after`` is the stamp of the last one it has.
        """


class GoesItsOwnWay(Protocol):
    """An operator that says with False that it does not do what it is told: a recorded robot.

    Its tracking error is then no fault.
    """

    follows_commands: bool


class BeginsEpisodes(Protocol):
    """An operator that wants to know: a simulation puts its objects in place."""

    def begin_episode(self, instruction: str, episode: int) -> None:
        """Episode number ``episode`` (from 0) begins; the arm has not moved in it yet."""


class EndsEpisodes(Protocol):
    """An operator that can tell that nothing is left to do; asked after each command."""

    def task_done(self) -> bool:
        """Whether the episode can end here."""


class JudgesTasks(Protocol):
    """An operator that can tell whether the task is done; asked at the end of an episode."""

    def task_success(self) -> bool:
        """Whether it is, as of now."""


class ContinuesChunks(Protocol):
    """A policy that can make a chunk that goes on from another: what ``rtc`` asks for.

    Where only some objects of a class can, an attribute ``continues`` says whether this one does.
    """

    def continue_action(
        self, observation: Observation, rest: Continuation
    ) -> npt.NDArray[np.float64]:
        """``(horizon, dim)`` actions in physical units that agree with ``rest``."""


class BindsToEmbodiment(Protocol):
    """An action filter that names joints, or depends on their limits."""

    def bind(self, embodiment: EmbodimentSpec) -> None:
        """Called once, before the robot is connected. Raises ConfigError if it does not fit."""


class Resets(Protocol):
    """An action filter that remembers something."""

    def reset(self, pose: npt.NDArray[np.float64]) -> None:
        """An episode begins with the arm at ``(dim,)`` ``pose``."""


def can_continue(policy: object) -> bool:
    """Whether ``policy`` has a ``continue_action`` that works."""
    able = callable(getattr(policy, "continue_action", None))
    return able and bool(getattr(policy, "continues", True))
