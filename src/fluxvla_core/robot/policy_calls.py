"""Asking the policy: in a thread of its own, with its chunks checked there."""

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

from fluxvla_core.contracts.policy import Continuation, Policy
from fluxvla_core.errors import FluxError
from fluxvla_core.robot.control.chunks import check_chunk
from fluxvla_core.robot.control.delays import POLICY, DelayMonitor
from fluxvla_core.robot.control.policy_client import Answer, PolicyFailed
from fluxvla_core.robot.control.safety import BadChunk, SafetySettings
from fluxvla_core.robot.events import RobotReading
from fluxvla_core.spec.embodiment import EmbodimentSpec

Array = npt.NDArray[np.float64]
T = TypeVar("T")


@dataclass(frozen=True)
class PolicyAnswer(Answer):
    """A policy's answer to a reading, as it came.

    Args:
        reading: that it was asked with.
        chunk: as it came.
        stages: seconds, by stage; ``policy`` is all of it.
    """

    reading: RobotReading
    chunk: Any
    stages: Mapping[str, float]


class PolicyCaller:
    """Asks a policy for chunks in one episode, and checks that each is a motion for the robot.

    Args:
        policy: loaded.
        embodiment: the robot's.
        safety: thresholds of the checks.
        delays: notes how long calls take.
        seed: the policy's seed in this episode.
    """

    def __init__(
        self,
        policy: Policy,
        embodiment: EmbodimentSpec,
        safety: SafetySettings,
        delays: DelayMonitor,
        seed: int,
    ) -> None:
        self.policy = policy
        self._embodiment = embodiment
        self._safety = safety
        self._delays = delays
        self._seed = seed

    def reset(self) -> None:
        """Begin the episode, also once more after an answer that only warmed the policy up.

        Raises:
            PolicyFailed: the policy raised something that is no error of this project's.
        """
        try:
            with self._delays.of(POLICY):
                self.policy.reset(self._seed)
        except FluxError:
            raise
        except (Exception, SystemExit) as error:
            raise PolicyFailed(
                f"the policy raised {type(error).__name__} in reset(): {error}"
            ) from error

    def ask(self, reading: RobotReading, rest: Continuation | None) -> PolicyAnswer:
        """The policy's answer; ``rest`` of a chunk is what it has to continue.

        Raises:
            PolicyFailed: the policy raised something that is no error of this project's.
            FluxError: what the policy raised.
        """
        policy: Any = self.policy
        began = time.perf_counter()
        try:
            with self._delays.of(POLICY):
                if rest is None:
                    chunk = policy.predict_action(reading.observation)
                else:
                    chunk = policy.continue_action(reading.observation, rest)
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
            actions = self._actions(chunk)
        except BadChunk as error:
            return PolicyAnswer(reading.at, None, error, reading, chunk, stages)
        return PolicyAnswer(reading.at, actions, None, reading, chunk, stages)

    def _actions(self, chunk: Any) -> Array:
        policy = self.policy
        actions = check_chunk(chunk, self._embodiment, policy.action_rate_hz, self._safety).copy()
        if len(actions) != policy.horizon:
            raise BadChunk(
                f"the policy's chunk has {len(actions)} actions; it said {policy.horizon}"
            )
        actions.flags.writeable = False
        return actions


class PolicyThread:
    """One thread in which a policy thinks, so that the one that sends commands never waits for it.

    Runs jobs one after the other in a daemon thread; a job that hangs cannot keep the process.

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
