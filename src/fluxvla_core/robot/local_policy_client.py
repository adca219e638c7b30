"""``LocalPolicyClient``: asks a policy that computes in a thread of this process."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.frame import Observation
from fluxvla_core.contracts.policy import Continuation, Policy
from fluxvla_core.errors import FluxError
from fluxvla_core.robot.control.chunks import check_chunk
from fluxvla_core.robot.control.delays import POLICY, DelayMonitor, DelaySource
from fluxvla_core.robot.control.joiners import Ahead
from fluxvla_core.robot.control.policy_client import Answer, PolicyClient, PolicyFailed
from fluxvla_core.robot.control.safety import BadChunk, SafetySettings
from fluxvla_core.robot.events import ChunkAccepted, Event, Refused, RobotReading
from fluxvla_core.robot.observation import ObservationReader
from fluxvla_core.robot.observation_history import ObservationHistory
from fluxvla_core.robot.policy_thread import PolicyThread
from fluxvla_core.robot.robot import Robot
from fluxvla_core.spec.embodiment import EmbodimentSpec

Array = npt.NDArray[np.float64]


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

    def ask(
        self, reading: RobotReading, seen: Observation, rest: Continuation | None
    ) -> PolicyAnswer:
        """The policy's answer; ``rest`` of a chunk is what it has to continue.

        Args:
            seen: the observation of ``reading``, with the history that the policy needs.

        Raises:
            PolicyFailed: the policy raised something that is no error of this project's.
            FluxError: what the policy raised.
        """
        policy: Any = self.policy
        began = time.perf_counter()
        try:
            with self._delays.of(POLICY):
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


class LocalPolicyClient(PolicyClient):
    """Observes a robot and asks a policy, in one episode.

    On a robot both happen in the policy's thread. In a lockstep simulation observing happens in the
    thread that sends commands: renderers are bound to one.

    Args:
        robot: the connected robot.
        reader: reads the robot's observations.
        history: keeps those of before, for a policy that acts on several.
        policy: answers them with chunks.
        thread: the thread in which the policy computes.
        emit: takes the events ``ChunkAccepted`` and ``Refused``.
    """

    def __init__(
        self,
        robot: Robot,
        reader: ObservationReader,
        history: ObservationHistory,
        policy: PolicyCaller,
        thread: PolicyThread,
        emit: Callable[[Event], None],
    ) -> None:
        self._robot = robot
        self._reader = reader
        self._history = history
        self._policy = policy
        self._thread = thread
        self._emit = emit

    def first_state(self) -> Array:
        return self._reader.first().state

    def reset(self) -> None:
        self._policy.reset()
        self._history.reset()

    def ask(self, ahead: Ahead | None) -> Future[Answer]:
        if self._robot.lockstep:
            reading, seen = self._history.read()
            return self._thread.submit(lambda: self._think(reading, seen, ahead))
        return self._thread.submit(lambda: self._think(*self._history.read(), ahead))

    def ticked(self) -> None:
        if not self._history.due():
            return
        if self._robot.lockstep:
            self._history.sample()
        elif self._thread.idle_within(0.0):
            # What goes wrong is raised by the next question's own reading.
            self._thread.submit(self._history.sample)

    def accepted(self, answer: Answer) -> None:
        assert isinstance(answer, PolicyAnswer)
        now = self._robot.clock.now()
        self._emit(ChunkAccepted(now, answer.reading, answer.checked(), answer.stages))

    def refused(self, answer: Answer) -> None:
        assert isinstance(answer, PolicyAnswer)
        self._emit(Refused(self._robot.clock.now(), "chunk", {"answer": answer.chunk}))

    def slowest_since(self, since: float) -> tuple[DelaySource, float]:
        return self._robot.delays.longest(since)

    def _think(self, reading: RobotReading, seen: Observation, ahead: Ahead | None) -> Answer:
        rest = None if ahead is None else ahead.seen_at(reading.at, self._policy.policy.horizon)
        return self._policy.ask(reading, seen, rest)
