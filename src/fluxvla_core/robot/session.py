"""What happens between the episodes of a run: tasks are asked for, the arm is held.

Between two episodes the arm holds: its last command is sent again at every tick, because some
drivers stop an arm when commands cease. The safety rules hold as in an episode. After a stop
nothing is sent and no task is taken until the task source says ``rearm``.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from fluxvla_core.control.interrupt import Interrupts
from fluxvla_core.control.policy_client import PolicyFailed
from fluxvla_core.control.safety import Latch
from fluxvla_core.errors import FluxError, NotReady, SafetyStop
from fluxvla_core.robot.engine import Engine
from fluxvla_core.robot.policy_thread import PolicyThread
from fluxvla_core.robot.tasks import REARM, Task, TaskSource, tasks

_POLL_S = 0.02
# How long a policy's answer may take that nobody waits for any more.
_PATIENCE_S = 1.0
_KEPT = ("task", "outcome", "success", "steps")


class RobotSession:
    """Asks for tasks, holds the arm meanwhile, and decides whether a stop ends the run.

    Args:
        source: the opened task source.
        known: task id -> instruction.
        free: whether instructions that are not in ``known`` are allowed.
        engine: commands the robot.
        latch, interrupts, thread: shared by all episodes of the run.
    """

    def __init__(
        self,
        source: TaskSource,
        known: Mapping[str, str],
        free: bool,
        engine: Engine,
        latch: Latch,
        interrupts: Interrupts,
        thread: PolicyThread,
    ) -> None:
        self._latch, self._interrupts, self._thread = latch, interrupts, thread
        self._engine = engine
        self._source = source
        self._known = known
        self._free = free
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
        return tasks(self._source, self._known, self._idle, self._heard, self._free)

    @contextmanager
    def episode(self, task: Task) -> Iterator[None]:
        """Entered while the task's episode runs.

        What stopped the robot is not raised where somebody can say ``rearm``: the run continues
        without motion.
        """
        try:
            yield
        except (SafetyStop, PolicyFailed, NotReady) as error:
            self._source.report(f"{task.name}: failed")
            self._stopped(error)
        except BaseException as error:
            self._source.report(f"{task.name}: failed: {error}")
            raise

    def ended(self, task: Task, summary: Mapping[str, Any]) -> None:
        """Called with the summary of an episode that ended well."""
        if self._source.waits:
            self._source.announce(_outcome(task, summary))
        self._count += 1
        self._last = {key: summary[key] for key in _KEPT}

    def result(self) -> dict[str, Any]:
        """The last episode's task, outcome, success and steps, and how many there were.

        Raises:
            SafetyStop: the robot was stopped, and nobody said ``rearm``.
        """
        trip = self._latch.tripped
        if self._failure is not None and trip:
            # What stopped it was reported then.
            raise SafetyStop(
                f"the run ended while the robot was stopped by rule {trip.rule}",
                next=f"say {REARM!r} before it ends, once the cause is removed",
            )
        return {"episodes": self._count, **self._last}

    def _stopped(self, error: FluxError) -> None:
        """Continue without motion where somebody can say ``rearm``; else raise ``error``."""
        self._engine.release()
        # A policy that hangs cannot be asked again.
        if not self._source.waits or not self._thread.idle_within(_PATIENCE_S):
            self._source.report(str(error))
            raise error
        self._failure = error
        self._interrupts.resume()
        self._source.announce(f"{error}\nstopped; {REARM!r} allows motion again")

    def _idle(self) -> None:
        self._interrupts.deferred = True
        self._interrupts.check()
        if not self._engine.holding:
            time.sleep(_POLL_S)
            return
        try:
            self._engine.hold()
        except (SafetyStop, NotReady) as error:
            self._stopped(error)

    def _heard(self, line: str) -> bool:
        trip = self._latch.tripped
        if not self._source.waits:
            self._latch.check()
        if line.casefold() != REARM:
            if trip is not None:
                self._source.announce(
                    f"still stopped by rule {trip.rule}: {trip.what}\n"
                    f"look at the robot, remove the cause, then say {REARM!r}"
                )
            return trip is not None
        self._engine.rearm()
        self._source.announce("nothing was stopped" if trip is None else "motion is allowed again")
        return True


def _outcome(task: Task, summary: Mapping[str, Any]) -> str:
    """How a task ended, in a line."""
    verdict = {True: ", success", False: ", no success", None: ""}[summary.get("success")]
    return f"{task.name}: {summary['outcome']}{verdict}, {summary['steps']} commands"
