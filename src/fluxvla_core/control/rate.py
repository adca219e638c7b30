"""A steady beat on absolute deadlines: being late once does not shift every later command."""

from __future__ import annotations

import math
from collections.abc import Callable

from fluxvla_core.contracts.protocols import Clock
from fluxvla_core.control import priority
from fluxvla_core.control.clock import MonotonicClock, in_lockstep


class Rate:
    """``sleep()`` returns at the next deadline; deadlines are ``1 / hz`` apart.

    Deadlines that were missed are skipped, never made up for: two commands sent at once would ask
    the arm for a jump. Two beats are at least half a period apart, however late the first one was.

    What a command is made of takes a while, and not always the same. So ``sleep`` may return
    ``lead_s`` early, and whoever has the command ready calls ``wait()`` for the deadline itself; in
    real time no other thread of the interpreter comes between.

    In a lockstep simulation both return at once.

    Args:
        hz: beats a second.
        clock: whose time counts; the monotonic clock by default.
        lead_s: how long before each deadline ``sleep`` returns, less than a period.
        on_beat: called at each beat, after the wait; what it raises leaves ``sleep``. The runner
            supervises there, so that a loop of one's own around ``rate.sleep()`` is supervised too.

    ``beats`` were had and ``skipped`` were not; ``late_s`` tells how late the last one was, or,
    once ``wait`` was called, what was sent at the last deadline.
    """

    def __init__(
        self,
        hz: float,
        clock: Clock | None = None,
        on_beat: Callable[[], None] | None = None,
        lead_s: float = 0.0,
    ) -> None:
        if not hz > 0:
            raise ValueError(f"a rate must be positive, got {hz} Hz")
        self.hz = hz
        self.period = 1.0 / hz
        self.clock: Clock = clock or MonotonicClock()
        if not 0.0 <= lead_s < self.period:
            raise ValueError(f"a lead must be shorter than a period, got {lead_s} s at {hz} Hz")
        self.on_beat = on_beat
        self.lead_s = lead_s
        self._lockstep = in_lockstep(self.clock)
        self._keeps = lead_s > 0.0 and type(self.clock) is MonotonicClock
        self.beats = 0
        self.skipped = 0
        self.late_s = 0.0
        # Of the next return of ``sleep``, and of the next ``wait``.
        self._deadline: float | None = None
        self._due: float | None = None
        self._woke: float | None = None
        self._waits = False

    def reset(self) -> None:
        """Begin anew: the next deadline is one period from the next ``sleep``'s call."""
        self._deadline = self._due = self._woke = None

    def sleep(self) -> float:
        """Wait for the next deadline.

        Returns:
            How late this returns, in seconds; 0 in a lockstep simulation.
        """
        if self._lockstep:
            # Time passed with the command; waiting for more of it would let the robot live on.
            self._beat()
            return 0.0
        now = self.clock.now()
        # The first call comes right after the first command: the deadline is a period later.
        first = now + self.period - self.lead_s
        deadline = first if self._deadline is None else self._deadline
        # Deadlines that are over, but for the last of them, and those too near to a late beat.
        over = int(max(0.0, now - deadline) / self.period)
        near = 0
        if self._woke is not None:
            near = math.ceil((self._woke + self.period / 2 - deadline) / self.period - 1e-6)
        missed = max(over, near, 0)
        self.skipped += missed
        deadline += missed * self.period
        if self._keeps:
            priority.share()
        self.clock.sleep_until(deadline)
        if self._keeps:
            priority.keep()
        self._woke = self.clock.now()
        late = max(0.0, self._woke - deadline)
        if not self._waits:
            self.late_s = late
        self._due = deadline + self.lead_s
        self._deadline = deadline + self.period
        self._beat()
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
                priority.wait_until(self._due)
            else:
                self.clock.sleep_until(self._due)
            self.late_s = max(0.0, self.clock.now() - self._due)
        return self.late_s

    def _beat(self) -> None:
        self.beats += 1
        if self.on_beat is not None:
            self.on_beat()
