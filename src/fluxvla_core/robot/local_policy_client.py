"""``LocalPolicyClient``: asks a policy that computes in a thread of this process."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future

import numpy as np
import numpy.typing as npt

from fluxvla_core.robot.control.delays import DelaySource
from fluxvla_core.robot.control.joiners import Ahead
from fluxvla_core.robot.control.policy_client import Answer, PolicyClient
from fluxvla_core.robot.events import ChunkAccepted, Event, Refused, RobotReading
from fluxvla_core.robot.observation import ObservationReader
from fluxvla_core.robot.policy_calls import PolicyAnswer, PolicyCaller, PolicyThread
from fluxvla_core.robot.robot import Robot

Array = npt.NDArray[np.float64]


class LocalPolicyClient(PolicyClient):
    """Observes a robot and asks a policy, in one episode.

    On a robot both happen in the policy's thread. In a lockstep simulation observing happens in the
    thread that sends commands: renderers are bound to one.

    Args:
        robot: the connected robot.
        reader: reads the robot's observations.
        policy: answers them with chunks.
        thread: the thread in which the policy computes.
        emit: takes the events ``ChunkAccepted`` and ``Refused``.
    """

    def __init__(
        self,
        robot: Robot,
        reader: ObservationReader,
        policy: PolicyCaller,
        thread: PolicyThread,
        emit: Callable[[Event], None],
    ) -> None:
        self._robot = robot
        self._reader = reader
        self._policy = policy
        self._thread = thread
        self._emit = emit

    def first_state(self) -> Array:
        return self._reader.first().state

    def reset(self) -> None:
        self._policy.reset()

    def ask(self, ahead: Ahead | None) -> Future[Answer]:
        if self._robot.lockstep:
            reading = self._reader.read()
            return self._thread.submit(lambda: self._think(reading, ahead))
        return self._thread.submit(lambda: self._think(self._reader.read(), ahead))

    def accepted(self, answer: Answer) -> None:
        assert isinstance(answer, PolicyAnswer)
        now = self._robot.clock.now()
        self._emit(ChunkAccepted(now, answer.reading, answer.checked(), answer.stages))

    def refused(self, answer: Answer) -> None:
        assert isinstance(answer, PolicyAnswer)
        self._emit(Refused(self._robot.clock.now(), "chunk", {"answer": answer.chunk}))

    def slowest_since(self, since: float) -> tuple[DelaySource, float]:
        return self._robot.delays.longest(since)

    def _think(self, reading: RobotReading, ahead: Ahead | None) -> Answer:
        rest = None if ahead is None else ahead.seen_at(reading.at, self._policy.policy.horizon)
        return self._policy.ask(reading, rest)
