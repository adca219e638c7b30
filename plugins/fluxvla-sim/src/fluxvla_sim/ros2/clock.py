"""The clock of a robot that is simulated slower than real time."""

from __future__ import annotations

import time


class SlowedClock:
    """The monotonic clock at ``factor`` of its speed: what is a second here takes 1 / factor.

    A control loop that lives by it sends 50 commands in a simulated second, whatever that takes;
    its deadlines, watchdogs and latencies are all in the robot's time. A policy so has more time to
    think than on a real robot: results must state the factor.
    """

    lockstep = False

    def __init__(self, factor: float) -> None:
        self.factor = factor

    def now(self) -> float:
        return time.monotonic() * self.factor

    def sleep_until(self, deadline: float) -> None:
        left = deadline / self.factor - time.monotonic()
        if left > 0:
            time.sleep(left)
