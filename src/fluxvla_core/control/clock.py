"""Clocks, and the control rate: the monotonic clock for robots, a stepped one for simulations.

What a clock must offer is ``contracts.Clock``: ``now()`` and ``sleep_until(deadline)``. A simulated
operator that steps its physics in ``send_action`` has a clock of its own as attribute ``clock``.
Its time stands still while a policy thinks and passes with each command, so that an episode is
the same on every machine; the loop then runs in lockstep with it. ``SimulatedClock`` is one.
"""

from __future__ import annotations

import math
import time
from typing import ClassVar

from fluxvla_core.contracts.robot import Clock, Operator
from fluxvla_core.control import realtime


class MonotonicClock(Clock):
    """Real time; wall-clock adjustments do not touch it."""

    lockstep: ClassVar[bool] = False

    def now(self) -> float:
        return time.monotonic()

    def sleep_until(self, deadline: float) -> None:
        left = deadline - time.monotonic()
        if left > 0:
            time.sleep(left)


class SimulatedClock(Clock):
    """Time that passes only by ``advance``, which the operator calls once for each command."""

    def __init__(self, start: float = 0.0) -> None:
        self._now = start

    def now(self) -> float:
        return self._now

    def advance(self, seconds: float) -> None:
        """Let time pass.

        Raises:
            ValueError: it would run backwards.
        """
        if not seconds >= 0:
            raise ValueError(f"time does not run backwards: {seconds}")
        self._now += seconds

    def sleep_until(self, deadline: float) -> None:
        """Return at once: waiting for time that only the next command makes would never end."""


def clock_of(operator: Operator) -> Clock:
    """The operator's own clock, or the monotonic one."""
    clock = operator.clock
    return MonotonicClock() if clock is None else clock


def in_lockstep(clock: Clock) -> bool:
    """Whether the clock's time stands still between commands."""
    return bool(Clock.adapt(clock).lockstep)


class Rate:
    """``sleep()`` returns at the next deadline; deadlines are ``1 / hz`` apart.

    Deadlines that were missed are skipped, never made up for: two commands sent at once would ask
    the arm for a jump. Two ticks are at least half a period apart, however late the first one was.

    Making a command takes a varying time. So ``sleep`` may return ``lead_s`` early; the caller
    makes the command, then calls ``wait()`` for the deadline itself. In real time the GIL is held
    during that wait.

    In a lockstep simulation both return at once.

    Args:
        hz: ticks a second.
        clock: source of the time; the monotonic clock by default.
        lead_s: how long before each deadline ``sleep`` returns, less than a period.

    ``ticks`` counts those that happened, ``skipped`` those missed; ``late_s`` is how late the last
    one was, or, once ``wait`` was called, how late what was sent at the last deadline.
    """

    def __init__(
        self,
        hz: float,
        clock: Clock | None = None,
        lead_s: float = 0.0,
    ) -> None:
        if not hz > 0:
            raise ValueError(f"a rate must be positive, got {hz} Hz")
        self.hz = hz
        self.period = 1.0 / hz
        self.clock: Clock = clock or MonotonicClock()
        if not 0.0 <= lead_s < self.period:
            raise ValueError(f"a lead must be shorter than a period, got {lead_s} s at {hz} Hz")
        self.lead_s = lead_s
        self._lockstep = in_lockstep(self.clock)
        self._keeps = lead_s > 0.0 and type(self.clock) is MonotonicClock
        self.ticks = 0
        self.skipped = 0
        self.late_s = 0.0
        # Of the next return of ``sleep``, and of the next ``wait``.
        self._deadline: float | None = None
        self._due: float | None = None
        self._woke: float | None = None
        self._waits = False

    def reset(self) -> None:
        """Reset: the next deadline is one period from the next ``sleep``'s call."""
        self._deadline = self._due = self._woke = None

    def sleep(self) -> float:
        """Wait for the next deadline.

        Returns:
            How late this returns, in seconds; 0 in a lockstep simulation.
        """
        if self._lockstep:
            # Time passed with the command; waiting for more of it would let the robot live on.
            self.ticks += 1
            return 0.0
        now = self.clock.now()
        # The first call comes right after the first command: the deadline is a period later.
        first = now + self.period - self.lead_s
        deadline = first if self._deadline is None else self._deadline
        # Deadlines that are over, but for the last of them, and those too near to a late tick.
        over = int(max(0.0, now - deadline) / self.period)
        near = 0
        if self._woke is not None:
            near = math.ceil((self._woke + self.period / 2 - deadline) / self.period - 1e-6)
        missed = max(over, near, 0)
        self.skipped += missed
        deadline += missed * self.period
        if self._keeps:
            realtime.share_gil()
        self.clock.sleep_until(deadline)
        if self._keeps:
            realtime.hold_gil()
        self._woke = self.clock.now()
        late = max(0.0, self._woke - deadline)
        if not self._waits:
            self.late_s = late
        self._due = deadline + self.lead_s
        self._deadline = deadline + self.period
        self.ticks += 1
        return late

    def wait(self) -> float:
        """Wait for the deadline that the last ``sleep`` returned ahead of; nothing before any.

        Returns:
            How late this returns, in seconds; 0 in a lockstep simulation.
        """
        self._waits = True
        self.late_s = 0.0
        if self._due is not None:
            if self._keeps:
                realtime.wait_until(self._due)
            else:
                self.clock.sleep_until(self._due)
            self.late_s = max(0.0, self.clock.now() - self._due)
        return self.late_s
