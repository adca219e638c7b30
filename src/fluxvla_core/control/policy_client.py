"""``PolicyClient``: queries a policy for the control loop, in this process or in another."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from fluxvla_core.control.delays import DelaySource
from fluxvla_core.control.joiners import PreviousChunk
from fluxvla_core.control.safety import BadChunk, Rule
from fluxvla_core.errors import RunFailed

Array = npt.NDArray[np.float64]


class PolicyFailed(RunFailed):
    """A policy raised something."""

    rule: ClassVar[str] = Rule.POLICY


class PolicyEnded(RunFailed):
    """A policy has no further answer: the episode ends well when the last one has been played."""

    outcome = "policy_ended"


@dataclass(frozen=True)
class Answer:
    """A policy's answer, as far as the control loop needs it.

    Args:
        observed: when the observation that it answers was made, on the robot's clock.
        actions: ``(T, D)`` targets, read-only; None if the chunk is refused.
        error: why the chunk is refused; None if it is not.
    """

    observed: float
    actions: Array | None
    error: BadChunk | None

    def checked(self) -> Array:
        """``(T, D)`` the actions.

        Raises:
            BadChunk: the chunk is refused.
        """
        if self.error is not None:
            raise self.error
        assert self.actions is not None, "an answer has actions or an error"
        return self.actions


class PolicyClient(ABC):
    """Observes the robot and queries the policy, for one episode.

    ``first_state`` and ``reset`` may take long and are called while nothing moves; the others
    return at once, ``slowest_since`` after a tenth of a second. Calls come from one thread at a
    time, but for ``query``, which a control process has called from a thread of its own.

    Where another process observes and thinks, ``meanwhile`` is called again and again while
    ``first_state`` or ``reset`` waits for it, if it is set: an arm that is held hears commands.
    """

    meanwhile: Callable[[], None] | None = None

    @abstractmethod
    def first_state(self) -> Array:
        """Wait for the first complete observation; its ``(state_dim,)`` state.

        Raises:
            NotReady: there was none in time.
            BadFrame: it is not what the embodiment describes.
            Interrupted: a signal came meanwhile.
        """

    @abstractmethod
    def reset(self) -> None:
        """Begin the episode for the policy, also once more after an answer that warmed it up.

        Raises:
            PolicyFailed: the policy raised something.
        """

    @abstractmethod
    def query(self, previous: PreviousChunk | None) -> Future[Answer]:
        """Observe, and query the policy.

        Args:
            previous: the chunk that the policy has to continue; None for none.

        Returns:
            The answer, or what observing or the policy raised.
        """

    @abstractmethod
    def ticked(self) -> None:
        """Called after each command of a policy's motion: time to look at the robot once more."""

    @abstractmethod
    def accepted(self, answer: Answer) -> None:
        """Called with an answer whose chunk is going to be played."""

    @abstractmethod
    def refused(self, answer: Answer) -> None:
        """Called with an answer whose chunk was refused: not finite, a wrong shape, or a jump."""

    @abstractmethod
    def slowest_since(self, since: float) -> tuple[DelaySource, float]:
        """The stage that took longest since ``since`` (monotonic, s), and its seconds."""
