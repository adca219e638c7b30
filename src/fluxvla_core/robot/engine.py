"""``Engine``: runs episodes on a robot, one after the other, and holds the arm in between."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.control import realtime
from fluxvla_core.robot.episode import Episode, EpisodeParts, EpisodeSettings
from fluxvla_core.robot.events import EpisodeObserver
from fluxvla_core.robot.tasks import Task


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
    """Base class of what commands a robot in a run, from this process or through another one.

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
        """Entered while there are episodes."""

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
        """Hold no more: the robot was stopped."""

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
