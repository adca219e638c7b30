"""A run on a robot: ``Engine`` runs episodes, ``RobotSession`` asks for tasks in between.

Between two episodes the arm holds: its last command is sent again at every tick, because some
drivers stop an arm when commands cease. The safety rules hold as in an episode. After a stop
nothing is sent and no task is taken until the task source says ``rearm``.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.control import realtime
from fluxvla_core.control.interrupt import Interrupts
from fluxvla_core.control.policy_client import PolicyFailed
from fluxvla_core.control.safety import Latch
from fluxvla_core.errors import FluxError, NotReady, SafetyStop
from fluxvla_core.robot.episode import Episode, EpisodeParts, EpisodeSettings
from fluxvla_core.robot.events import EpisodeObserver
from fluxvla_core.robot.tasks import REARM, Task, TaskSource, tasks

if TYPE_CHECKING:
    from fluxvla_core.robot.local_policy_client import PolicyThread

_POLL_S = 0.02
# How long a policy's answer may take that nobody waits for any more.
_PATIENCE_S = 1.0
_KEPT = ("task", "outcome", "success", "steps")


@dataclass
class RunHistory:
    """State that a runner keeps from one ``run()`` to the next.

    Args:
        episodes: number of episodes so far.
        commanded: ``(D,)`` the last command; None before any.
    """

    episodes: int = 0
    commanded: npt.NDArray[np.float64] | None = None


class Engine(ABC):
    """Base class: commands a robot in a run, from this process or through another one.

    ``stop_failure`` is what went wrong with the last stop.
    """

    stop_failure: str | None = None

    @abstractmethod
    def connect(self) -> None:
        """Connect to the robot.

        Raises:
            OperatorError: it cannot be connected to.
        """

    @abstractmethod
    def commanding(self) -> AbstractContextManager[object]:
        """A context around all episodes of a run."""

    @abstractmethod
    def run_episode(
        self,
        task: Task,
        number: int,
        seed: int,
        observers: Sequence[EpisodeObserver],
        folder: Path,
    ) -> None:
        """Run an episode.

        Args:
            task: the task to do.
            number: how many episodes there were before.
            seed: the seed of the policy.
            observers: receive every event.
            folder: of its record; there once the episode is prepared.

        Raises:
            Exception: what ended it before its time; the robot is stopped by then.
        """

    @property
    @abstractmethod
    def holding(self) -> bool:
        """Whether an episode's last command is sent again and again: some drivers stop an arm
        when commands cease."""

    @abstractmethod
    def hold(self) -> None:
        """Hold the arm for one more tick.

        Raises:
            SafetyStop: the latch was tripped, or the arm does not stay; it was stopped.
            OperatorError: the robot does not take it, or a stream fell silent; it was stopped.
        """

    @abstractmethod
    def release(self) -> None:
        """End the hold: the robot was stopped."""

    @abstractmethod
    def rearm(self) -> None:
        """Allow motion again after a stop."""

    @abstractmethod
    def episode_facts(self) -> Mapping[str, Any]:
        """Facts about the last episode from the operator (``Operator.episode_facts``)."""

    @abstractmethod
    def stop(self) -> str | None:
        """Bring the robot to a safe stop; None, or what went wrong. Never raises, never hangs."""

    @abstractmethod
    def close(self) -> str | None:
        """Disconnect; None, or what went wrong. Never raises, never hangs."""


class LocalEngine(Engine):
    """Commands the robot from the calling thread.

    Args:
        parts: the robot and what drives it.
        settings: how episodes are driven.
        history: of the runner's earlier runs; continued.
    """

    def __init__(self, parts: EpisodeParts, settings: EpisodeSettings, history: RunHistory) -> None:
        self._parts, self._settings, self._history = parts, settings, history
        # The one that ended last keeps the arm where it is; None where nothing but the arm's own
        # controller does.
        self._holding: Episode | None = None

    def connect(self) -> None:
        self._parts.robot.connect()

    def commanding(self) -> AbstractContextManager[object]:
        return nullcontext() if self._parts.robot.lockstep else realtime.real_time()

    def run_episode(
        self,
        task: Task,
        number: int,
        seed: int,
        observers: Sequence[EpisodeObserver],
        folder: Path,
    ) -> None:
        held, before = self._holding, self._history.commanded
        self._holding = None
        episode = Episode(self._parts, self._settings, observers, task, number, seed, before, held)
        try:
            episode.run()
        finally:
            self._history.commanded = episode.commanded
            self.stop_failure = episode.stop_failure
        if not self._parts.robot.lockstep:
            self._holding = episode

    @property
    def holding(self) -> bool:
        return self._holding is not None

    def hold(self) -> None:
        if self._holding is not None:
            self._holding.hold()

    def stop_held(self, error: FluxError) -> None:
        """Stop the arm that is held, because of ``error``: see ``Episode.stop_held``."""
        if self._holding is not None:
            self._holding.stop_held(error)

    def release(self) -> None:
        self._holding = None

    def rearm(self) -> None:
        self._parts.latch.rearm()

    def episode_facts(self) -> Mapping[str, Any]:
        return self._parts.robot.facts()

    def stop(self) -> str | None:
        return self._parts.robot.stop()

    def close(self) -> str | None:
        return self._parts.robot.close()


@dataclass(eq=False)
class RobotSession:
    """Asks for tasks, holds the arm meanwhile, and decides whether a stop ends the run.

    Args:
        source: the opened task source.
        known: task id -> instruction.
        free: whether instructions that are not in ``known`` are allowed.
        engine: commands the robot.
        latch, interrupts, thread: shared by all episodes of the run.
    """

    source: TaskSource
    known: Mapping[str, str]
    free: bool
    engine: Engine
    latch: Latch
    interrupts: Interrupts
    thread: PolicyThread

    def __post_init__(self) -> None:
        self._failure: FluxError | None = None
        self._count = 0
        self._last: dict[str, Any] = {}

    def tasks(self) -> Iterator[Task]:
        """The source's tasks, until it has none left; while it is asked, the arm is held.

        Raises:
            SafetyStop, NotReady: what ended the hold between two episodes, if nobody can say
                ``rearm``.
            Interrupted: a signal came.
        """
        return tasks(self.source, self.known, self._idle, self._heard, self.free)

    @contextmanager
    def episode(self, task: Task) -> Iterator[None]:
        """Entered while the task's episode runs.

        What stopped the robot is not raised where somebody can say ``rearm``: the run continues
        without motion.
        """
        try:
            yield
        except (SafetyStop, PolicyFailed, NotReady) as error:
            self.source.report(f"{task.name}: failed")
            self._stopped(error)
        except BaseException as error:
            self.source.report(f"{task.name}: failed: {error}")
            raise

    def ended(self, task: Task, summary: Mapping[str, Any]) -> None:
        """Called with the summary of an episode that ended well."""
        if self.source.waits:
            self.source.announce(_outcome(task, summary))
        self._count += 1
        self._last = {key: summary[key] for key in _KEPT}

    def result(self) -> dict[str, Any]:
        """The last episode's task, outcome, success and steps, and how many there were.

        Raises:
            SafetyStop: the robot was stopped, and nobody said ``rearm``.
        """
        trip = self.latch.tripped
        if self._failure is not None and trip:
            # What stopped it was reported then.
            raise SafetyStop(
                f"the run ended while the robot was stopped by rule {trip.rule}",
                next=f"say {REARM!r} before it ends, once the cause is removed",
            )
        return {"episodes": self._count, **self._last}

    def _stopped(self, error: FluxError) -> None:
        """Continue without motion where somebody can say ``rearm``; else raise ``error``."""
        self.engine.release()
        # A policy that hangs cannot be asked again.
        if not self.source.waits or not self.thread.idle_within(_PATIENCE_S):
            self.source.report(str(error))
            raise error
        self._failure = error
        self.interrupts.resume()
        self.source.announce(f"{error}\nstopped; {REARM!r} allows motion again")

    def _idle(self) -> None:
        self.interrupts.deferred = True
        self.interrupts.check()
        if not self.engine.holding:
            time.sleep(_POLL_S)
            return
        try:
            self.engine.hold()
        except (SafetyStop, NotReady) as error:
            self._stopped(error)

    def _heard(self, line: str) -> bool:
        trip = self.latch.tripped
        if not self.source.waits:
            self.latch.check()
        if line.casefold() != REARM:
            if trip is not None:
                self.source.announce(
                    f"still stopped by rule {trip.rule}: {trip.what}\n"
                    f"look at the robot, remove the cause, then say {REARM!r}"
                )
            return trip is not None
        self.engine.rearm()
        self.source.announce("nothing was stopped" if trip is None else "motion is allowed again")
        return True


def _outcome(task: Task, summary: Mapping[str, Any]) -> str:
    """How a task ended, in a line."""
    verdict = {True: ", success", False: ", no success", None: ""}[summary.get("success")]
    return f"{task.name}: {summary['outcome']}{verdict}, {summary['steps']} commands"
