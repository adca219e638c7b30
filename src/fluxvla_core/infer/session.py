"""The episodes of one run, one after the other, and what happens in between.

Between two episodes the arm holds: its last command is sent again at every beat, so that drivers
which stop an arm that they hear nothing for keep it where it is, and what goes wrong while nobody
moves it stops it as in an episode. After a stop nothing is sent and no task is taken, until whoever
gives the tasks says ``rearm``.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from fluxvla_core.control.interrupt import Interrupts
from fluxvla_core.control.worker import Worker
from fluxvla_core.errors import FluxError, NotReady, SafetyStop
from fluxvla_core.infer.episode import Episode
from fluxvla_core.infer.plan import PolicyFailed
from fluxvla_core.infer.sources import TaskSource, tasks
from fluxvla_core.infer.tasks import REARM, Task
from fluxvla_core.safety.trips import Latch

_LOOK_S = 0.02
_KEPT = ("task", "outcome", "success", "steps")


class Session:
    """Runs the tasks of a source.

    Args:
        source: open.
        known: id -> instruction.
        run_episode: does one task; its summary.
        latch, interrupts, worker: of the run.

    ``episode`` is the one that ended last, as ``run_episode`` leaves it here: it keeps the arm
    where it is. None where nothing holds the arm but its own controller.
    """

    def __init__(
        self,
        source: TaskSource,
        known: Mapping[str, str],
        run_episode: Callable[[Task], Mapping[str, Any]],
        latch: Latch,
        interrupts: Interrupts,
        worker: Worker,
    ) -> None:
        self.episode: Episode | None = None
        self._failure: FluxError | None = None
        self._source = source
        self._known = known
        self._run_episode = run_episode
        self._latch = latch
        self._interrupts = interrupts
        self._worker = worker

    def run(self) -> dict[str, Any]:
        """Until the source has no task left.

        Returns:
            The last episode's task, outcome, success and steps, and how many there were.

        Raises:
            SafetyStop, PolicyFailed, NotReady: what ended an episode, if nobody said ``rearm``.
            Interrupted: a signal came.
            Exception: what else ended an episode or the hold between two.
        """
        result: dict[str, Any] = {"episodes": 0}
        for task in tasks(self._source, self._known, self._idle, self._heard):
            try:
                summary = self._run_episode(task)
            except (SafetyStop, PolicyFailed, NotReady) as error:
                self._stopped(error)
                continue
            result = {"episodes": result["episodes"] + 1, **{key: summary[key] for key in _KEPT}}
        if self._failure is not None and self._latch.tripped:
            raise self._failure
        return result

    def _stopped(self, error: FluxError) -> None:
        """Go on, without motion, where somebody can say ``rearm``; else raise ``error``."""
        self.episode = None
        # A policy that still thinks cannot be asked again.
        if not self._source.waits or self._worker.busy:
            raise error
        self._failure = error
        self._interrupts.resume()
        self._source.tell(f"{error}\nstopped; {REARM!r} allows motion again")

    def _idle(self) -> None:
        self._interrupts.deferred = True
        self._interrupts.check()
        if self.episode is None:
            time.sleep(_LOOK_S)
            return
        try:
            self.episode.hold()
        except (SafetyStop, NotReady) as error:
            self._stopped(error)

    def _heard(self, line: str) -> bool:
        trip = self._latch.tripped
        if not self._source.waits:
            self._latch.check()
        if line.casefold() != REARM:
            if trip is not None:
                self._source.tell(
                    f"still stopped by rule {trip.rule}: {trip.what}\n"
                    f"look at the robot, remove the cause, then say {REARM!r}"
                )
            return trip is not None
        self._latch.rearm()
        self._source.tell("nothing was stopped" if trip is None else "motion is allowed again")
        return True
