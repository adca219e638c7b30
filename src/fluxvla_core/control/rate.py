"""A steady beat on absolute deadlines: being late once does not shift every later command."""

from __future__ import annotations

import time
from collections.abc import Callable

from fluxvla_core.contracts.protocols import Clock
from fluxvla_core.control.clock import MonotonicClock


class Rate:
    """``sleep()`` returns at the next deadline; deadlines are ``1 / hz`` apart.

    A deadline that was missed by more than a period is skipped, never made up for: two commands
    sent at once would ask the arm for twice the speed.

    Args:
        hz: beats a second.
        clock: whose time counts; the monotonic clock by default.
        on_beat: called at each beat, after the wait; what it raises leaves ``sleep``. The runner
            supervises there, so that a loop of one's own around ``rate.sleep()`` is supervised too.

    ``beats`` were had and ``skipped`` were not; ``late_s`` tells how late the last one was and
    ``work_s`` how much real time passed from the beat before to the call.
    """

    def __init__(
        self,
        hz: float,
        clock: Clock | None = None,
        on_beat: Callable[[], None] | None = None,
    ) -> None:
        if not hz > 0:
            raise ValueError(f"a rate must be positive, got {hz} Hz")
        self.hz = hz
        self.period = 1.0 / hz
        self.clock: Clock = clock or MonotonicClock()
        self.on_beat = on_beat
        self.beats = 0
        self.skipped = 0
        self.late_s = 0.0
        self.work_s = 0.0
        self._woke: float | None = None
        self._deadline: float | None = None

    def reset(self) -> None:
        """Begin anew: the next deadline is one period from the next ``sleep``'s call."""
        self._deadline = None
        self._woke = None

    def sleep(self) -> float:
        """Wait for the next deadline.

        Returns:
            How late it is when this returns, in seconds; 0 in a lockstep simulation.
        """
        now = self.clock.now()
        called = time.perf_counter()
        self.work_s = called - self._woke if self._woke is not None else 0.0
        # The first call comes right after the first command: the deadline is a period later.
        deadline = now + self.period if self._deadline is None else self._deadline
        missed = int(max(0.0, now - deadline) / self.period)
        self.skipped += missed
        deadline += missed * self.period
        self.clock.sleep_until(deadline)
        self.late_s = max(0.0, self.clock.now() - deadline)
        self._deadline = deadline + self.period
        self.beats += 1
        self._woke = time.perf_counter()
        if self.on_beat is not None:
            self.on_beat()
        return self.late_s
