"""The episodes of one run, one after the other, and what happens in between.

Between two episodes the arm holds: its last command is sent again at every tick, because some
drivers stop an arm when commands cease. The safety rules hold as in an episode. After a stop
nothing is sent and no task is taken until the task source says ``rearm``.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from fluxvla_core.errors import FluxError, NotReady, SafetyStop
from fluxvla_core.robot.control.interrupt import Interrupts
from fluxvla_core.robot.control.policy_client import PolicyFailed
from fluxvla_core.robot.control.safety import Latch
from fluxvla_core.robot.engine import Engine, RunHistory
from fluxvla_core.robot.events import EpisodeObserver
from fluxvla_core.robot.policy_thread import PolicyThread
from fluxvla_core.robot.tasks import REARM, Task, TaskSource, tasks

_POLL_S = 0.02
# How long a policy's answer may take that nobody waits for any more.
_PATIENCE_S = 1.0
_KEPT = ("task", "outcome", "success", "steps")


class RobotSession:
    """Runs the tasks of a source, and keeps what goes from one episode to the next.

    Args:
        source: the opened task source.
        known: task id -> instruction.
        free: whether instructions that are not in ``known`` are allowed.
        seed: the seed of the first episode's policy; each later episode adds 1.
        history: earlier episodes of the runner; the session continues it.
        engine: commands the robot.
        latch, interrupts, thread: shared by all episodes of the run.
    """

    def __init__(
        self,
        source: TaskSource,
        known: Mapping[str, str],
        free: bool,
        seed: int,
        history: RunHistory,
        engine: Engine,
        latch: Latch,
        interrupts: Interrupts,
        thread: PolicyThread,
    ) -> None:
        self.latch, self.interrupts, self.thread = latch, interrupts, thread
        self.engine = engine
        self._source = source
        self._known = known
        self._free = free
        self._seed = seed
        self._history = history
        self._failure: FluxError | None = None

    def run(self, run_episode: Callable[[Task], Mapping[str, Any]]) -> dict[str, Any]:
        """Until the source has no task left.

        Args:
            run_episode: does one task, by way of ``play``; its summary.

        Returns:
            The last episode's task, outcome, success and steps, and how many there were.

        Raises:
            SafetyStop, PolicyFailed, NotReady: what ended an episode, if nobody said ``rearm``.
            Interrupted: a signal came.
            Exception: what else ended an episode or the hold between two.
        """
        result: dict[str, Any] = {"episodes": 0}
        for task in tasks(self._source, self._known, self._idle, self._heard, self._free):
            try:
                summary = run_episode(task)
            except (SafetyStop, PolicyFailed, NotReady) as error:
                self._source.report(f"{task.name}: failed")
                self._stopped(error)
                continue
            except BaseException as error:
                self._source.report(f"{task.name}: failed: {error}")
                raise
            if self._source.waits:
                self._source.announce(_outcome(task, summary))
            result = {"episodes": result["episodes"] + 1, **{key: summary[key] for key in _KEPT}}
        trip = self.latch.tripped
        if self._failure is not None and trip:
            # What stopped it was reported then.
            raise SafetyStop(
                f"the run ended while the robot was stopped by rule {trip.rule}",
                next=f"say {REARM!r} before it ends, once the cause is removed",
            )
        return result

    def play(self, task: Task, observers: Sequence[EpisodeObserver], folder: Path) -> None:
        """Run the next episode; ``folder`` is its record's.

        Raises:
            Exception: what ended it before its time; the robot is stopped by then.
        """
        number = self._history.episodes
        self.engine.play(task, number, self._seed + number, observers, folder)
        self._history.episodes += 1

    def _stopped(self, error: FluxError) -> None:
        """Continue without motion where somebody can say ``rearm``; else raise ``error``."""
        self.engine.release()
        # A policy that hangs cannot be asked again.
        if not self._source.waits or not self.thread.idle_within(_PATIENCE_S):
            self._source.report(str(error))
            raise error
        self._failure = error
        self.interrupts.resume()
        self._source.announce(f"{error}\nstopped; {REARM!r} allows motion again")

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
        if not self._source.waits:
            self.latch.check()
        if line.casefold() != REARM:
            if trip is not None:
                self._source.announce(
                    f"still stopped by rule {trip.rule}: {trip.what}\n"
                    f"look at the robot, remove the cause, then say {REARM!r}"
                )
            return trip is not None
        self.engine.rearm()
        self._source.announce("nothing was stopped" if trip is None else "motion is allowed again")
        return True


def _outcome(task: Task, summary: Mapping[str, Any]) -> str:
    """How a task ended, in a line."""
    verdict = {True: ", success", False: ", no success", None: ""}[summary.get("success")]
    return f"{task.name}: {summary['outcome']}{verdict}, {summary['steps']} commands"
