"""Inference in an episode: ``LocalPolicyClient`` queries the policy, in a ``PolicyThread``.

On a robot observing and inference happen in a thread of their own, so that the one that sends
commands never waits for a camera or a policy. ``observations`` reads the robot.
"""

from __future__ import annotations

import queue
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import Future, wait
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.frame import Observation
from fluxvla_core.contracts.policy import Policy
from fluxvla_core.control.chunks import check_chunk
from fluxvla_core.control.delays import POLICY, DelaySource
from fluxvla_core.control.joiners import PreviousChunk
from fluxvla_core.control.policy_client import Answer, PolicyClient, PolicyFailed
from fluxvla_core.control.safety import BadChunk
from fluxvla_core.errors import FluxError
from fluxvla_core.robot.events import ChunkAccepted, ObservedFrame, Refused
from fluxvla_core.robot.observations import ObservationHistory, ObservationReader

T = TypeVar("T")
Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class PolicyAnswer(Answer):
    """A policy's answer to a query, as it came.

    Args:
        observed_frame: the observation of the query.
        chunk: as it came.
        stages: seconds, by stage; ``policy`` is all of it.
    """

    observed_frame: ObservedFrame
    chunk: Any
    stages: Mapping[str, float]


class LocalPolicyClient(PolicyClient):
    """Observes a robot and queries a policy of this process, in one episode.

    On a robot both happen in the policy's thread. In a lockstep simulation observing happens in the
    thread that sends commands: renderers are bound to one.

    Args:
        reader: reads the robot's observations.
        policy: answers them with chunks; loaded.
        seed: the policy's in this episode.
        thread: the thread in which the policy computes.
    """

    def __init__(
        self, reader: ObservationReader, policy: Policy, seed: int, thread: PolicyThread
    ) -> None:
        self._reader, self._policy, self._seed, self._thread = reader, policy, seed, thread
        self._robot, self._emit = reader.robot, reader.emit
        self._history = ObservationHistory(reader, policy)

    def first_state(self) -> Array:
        return self._reader.first().state

    def reset(self) -> None:
        try:
            with self._robot.delays.of(POLICY):
                self._policy.reset(self._seed)
        except FluxError:
            raise
        except (Exception, SystemExit) as error:
            raise PolicyFailed(
                f"the policy raised {type(error).__name__} in reset(): {error}"
            ) from error
        self._history.reset()

    def query(self, previous: PreviousChunk | None) -> Future[Answer]:
        if self._robot.lockstep:
            observed, seen = self._history.read()
            return self._thread.submit(lambda: self._predict(observed, seen, previous))
        return self._thread.submit(lambda: self._predict(*self._history.read(), previous))

    def ticked(self) -> None:
        if not self._history.due():
            return
        if self._robot.lockstep:
            self._history.sample()
        elif self._thread.idle_within(0.0):
            # What goes wrong is raised by the next query's own observation.
            self._thread.submit(self._history.sample)

    def accepted(self, answer: Answer) -> None:
        assert isinstance(answer, PolicyAnswer)
        now = self._robot.clock.now()
        self._emit(ChunkAccepted(now, answer.observed_frame, answer.checked(), answer.stages))

    def refused(self, answer: Answer) -> None:
        assert isinstance(answer, PolicyAnswer)
        self._emit(Refused(self._robot.clock.now(), "chunk", {"answer": answer.chunk}))

    def slowest_since(self, since: float) -> tuple[DelaySource, float]:
        return self._robot.delays.longest(since)

    def _predict(
        self, observed: ObservedFrame, seen: Observation, previous: PreviousChunk | None
    ) -> Answer:
        """The policy's answer to a query, its chunk checked; in the policy's thread."""
        policy: Any = self._policy
        rest = None if previous is None else previous.continuation(observed.at, policy.horizon)
        began = time.perf_counter()
        try:
            with self._robot.delays.of(POLICY):
                if rest is None:
                    chunk = policy.predict_action(seen)
                else:
                    chunk = policy.continue_action(seen, rest)
        except FluxError:
            raise
        except (Exception, SystemExit) as error:
            if isinstance(error, MemoryError):
                # What the policy computed with is given back: the record needs some of it.
                traceback.clear_frames(error.__traceback__)
            raise PolicyFailed(f"the policy raised {type(error).__name__}: {error}") from error
        stages = {"policy": time.perf_counter() - began, **policy.stages}
        # Checked in this thread: for arrays of a chunk's size numpy releases the GIL, and the
        # thread that sends would have to get it again.
        try:
            actions = self._checked(chunk)
        except BadChunk as error:
            return PolicyAnswer(observed.at, None, error, observed, chunk, stages)
        return PolicyAnswer(observed.at, actions, None, observed, chunk, stages)

    def _checked(self, chunk: Any) -> Array:
        """``(T, D)`` the actions of a chunk, read-only.

        Raises:
            BadChunk: it is no motion for the robot, or not as long as the policy says.
        """
        policy, embodiment = self._policy, self._robot.embodiment
        actions = check_chunk(chunk, embodiment, policy.action_rate_hz, self._reader.safety).copy()
        if len(actions) != policy.horizon:
            raise BadChunk(
                f"the policy's chunk has {len(actions)} actions; it said {policy.horizon}"
            )
        actions.flags.writeable = False
        return actions


class PolicyThread:
    """A daemon thread that runs jobs one after the other; a job that hangs cannot keep the process.

    ``concurrent.futures.ThreadPoolExecutor`` would wait for a hung job when the program ends.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._jobs: queue.SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = (
            queue.SimpleQueue()
        )
        self._thread: threading.Thread | None = None
        self._newest: Future[Any] | None = None

    def idle_within(self, seconds: float) -> bool:
        """Whether no job runs or waits any more after so many seconds at most."""
        return self._newest is None or bool(wait((self._newest,), seconds).done)

    def submit(self, job: Callable[[], T]) -> Future[T]:
        """Have ``job`` run; its result, or what it raised, is in the future."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
            self._thread.start()
        future: Future[T] = Future()
        self._newest = future
        self._jobs.put((future, job))
        return future

    def close(self, timeout: float) -> bool:
        """Let the thread end after its present job; whether it did within ``timeout`` seconds."""
        if self._thread is None:
            return True
        self._jobs.put(None)
        self._thread.join(timeout)
        ended = not self._thread.is_alive()
        self._thread = None
        return ended

    def _run(self) -> None:
        while (item := self._jobs.get()) is not None:
            future, job = item
            try:
                future.set_result(job())
            except BaseException as error:  # noqa: BLE001 - it is raised where the result is read
                future.set_exception(error)
