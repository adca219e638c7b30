"""Time as the loop sees it: the monotonic clock for robots, a stepped one for simulations.

What a clock must offer is ``contracts.Clock``: ``now()`` and ``sleep_until(deadline)``. A simulated
operator that steps its physics in ``send_action`` has a clock of its own as attribute ``clock``.
Its time stands still while a policy thinks and passes with each command, so that an episode is
the same on every machine; the loop then runs in lockstep with it. ``SimulatedClock`` is one.
"""

from __future__ import annotations

import time

from fluxvla_core.contracts.protocols import Clock


class MonotonicClock:
    """Real time; wall-clock adjustments do not touch it."""

    lockstep = False

    def now(self) -> float:
        return time.monotonic()

    def sleep_until(self, deadline: float) -> None:
        left = deadline - time.monotonic()
        if left > 0:
            time.sleep(left)


class SimulatedClock:
    """Time that passes only by ``advance``, which the operator calls once for each command."""

    lockstep = True

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


def clock_of(operator: object) -> Clock:
    """The operator's own clock, or the monotonic one."""
    clock: Clock | None = getattr(operator, "clock", None)
    return clock if clock is not None else MonotonicClock()


def in_lockstep(clock: Clock) -> bool:
    """Whether time stands still between commands: what a clock of one's own means by default."""
    own = not isinstance(clock, MonotonicClock)
    return bool(getattr(clock, "lockstep", own))
