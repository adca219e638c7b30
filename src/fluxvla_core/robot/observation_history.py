"""``ObservationHistory``: earlier observations for a policy that acts on several (``n_obs_steps``).

The policy takes them one action apart, and is queried less often. So the robot is also read between
two queries, at the rate of the actions, by the policy's thread. During inference that thread cannot
read the robot; if an observation is missing after it, the query waits until as many were made as
the policy takes, one for each action.

An observation of the history is the one that was made nearest to its time, at most 0.6 of an action
away; in a lockstep simulation whose actions are whole control steps it is that of its time.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from fluxvla_core.contracts.frame import Observation
from fluxvla_core.contracts.policy import Policy, with_history
from fluxvla_core.control.safety import BadTiming
from fluxvla_core.robot.events import Event, Remembered, RobotReading
from fluxvla_core.robot.robot import Robot

_AWAY = 0.6  # of an action: half of one, where it is read once an action, and what threads add
_EARLY = 0.1  # of an action: ticks come a little early or late
_NO_FURTHER = 1e-6  # s, what sums of a clock's steps are rounded by


@dataclass
class _Kept:
    """A reading that was begun ``at`` and done at ``made``, and whether it is an event yet."""

    at: float
    made: float
    reading: RobotReading
    emitted: bool

    @property
    def observation(self) -> Observation:
        seen: Observation = {**self.reading.observation}  # type: ignore[typeddict-item]
        return seen


class ObservationHistory:
    """Reads what one policy is asked with in one episode. All but ``due`` in the reading thread.

    Args:
        read: reads the robot for a question.
        sample: reads it between two questions.
        robot: whose clock counts.
        policy: says how many observations it takes, and how far they are apart.
        patience_s: how long a question may wait for a history that is complete.
        emit: takes the events ``Remembered``: a record has what a policy was asked with.
        sleep: waits so many seconds.
    """

    def __init__(
        self,
        read: Callable[[], RobotReading],
        sample: Callable[[], RobotReading],
        robot: Robot,
        policy: Policy,
        patience_s: float,
        emit: Callable[[Event], None],
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.steps = policy.n_obs_steps
        self._read, self._sample = read, sample
        self._robot, self._emit, self._sleep = robot, emit, sleep
        self._apart, self._patience_s = 1.0 / policy.action_rate_hz, patience_s
        self._kept: deque[_Kept] = deque()
        self._first = 0.0
        self._next: float | None = None

    def reset(self) -> None:
        """Begin an episode."""
        self._kept.clear()
        self._next = None

    def due(self) -> bool:
        """Whether the robot is to be read for the history, now that nobody asks."""
        if self.steps == 1 or self._next is None:
            return False
        now, apart = self._robot.clock.now(), self._apart
        if now < self._next - _EARLY * apart:
            return False
        self._next = max(self._next + apart, now + apart / 2)
        return True

    def sample(self) -> None:
        """Read the robot for the history.

        Raises:
            BadFrame, BadTiming: as ``ObservationReader.read``.
        """
        at = self._robot.clock.now()
        self._keep(at, self._sample(), emitted=False)

    def read(self) -> tuple[RobotReading, Observation]:
        """What the policy is asked with: the robot's reading, and its observation with the history.

        Raises:
            BadFrame, BadTiming, NotFollowing: as ``ObservationReader.read``; or the robot cannot
                be read as often as the policy needs it.
        """
        began = self._robot.clock.now()
        while True:
            at = self._robot.clock.now()
            reading = self._read()
            present: Observation = {**reading.observation}  # type: ignore[typeddict-item]
            if self.steps == 1:
                return reading, present
            before = self._before(at)
            self._keep(at, reading, emitted=True)
            if before is not None:
                self._emit_used(before)
                seen = [each.observation for each in before]
                return reading, with_history(present, self.steps, seen)
            now = self._robot.clock.now()
            if self._robot.lockstep or now - began > self._patience_s + self.steps * self._apart:
                raise BadTiming(
                    f"the policy acts on {self.steps} observations {self._apart:.3g} s apart "
                    f"(n_obs_steps), and the robot was not read that often: "
                    f"{self._robot.frame_call.name} took {now - at:.2f} s",
                    cause="the cameras or this machine are too slow for the policy's action rate",
                )
            self._sleep(max(at + self._apart - now, 0.0))

    def _emit_used(self, before: list[_Kept]) -> None:
        for each in before:
            if not each.emitted:
                each.emitted = True
                self._emit(Remembered(each.made, each.reading))

    def _keep(self, at: float, reading: RobotReading, emitted: bool) -> None:
        if not self._kept:
            self._first = at
        self._kept.append(_Kept(at, self._robot.clock.now(), reading, emitted))
        while self._kept[0].at < at - self.steps * self._apart:
            self._kept.popleft()
        if self._next is None or at + self._apart / 2 > self._next:
            self._next = at + self._apart

    def _before(self, at: float) -> list[_Kept] | None:
        """The readings before ``at``; None where one is missing, fewer where the episode began.

        The first of an episode is repeated, by ``with_history``.
        """
        found: list[_Kept] = []
        for back in reversed(range(1, self.steps)):
            wanted = at - back * self._apart
            if not self._kept:
                continue
            if wanted < self._first + _NO_FURTHER:
                found.append(self._kept[0])
                continue
            seen = min(self._kept, key=lambda each: abs(each.at - wanted))
            if abs(seen.at - wanted) > _AWAY * self._apart:
                return None
            found.append(seen)
        return found
