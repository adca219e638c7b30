"""Ctrl-C and SIGTERM while a robot moves: answered at the next beat, then a safe stop."""

from __future__ import annotations

import signal
import threading
from types import FrameType, TracebackType
from typing import Any

from fluxvla_core.errors import RunFailed


class Interrupted(BaseException):
    """A signal asked the run to end. Not an ``Exception``: nobody's ``except`` may swallow it."""

    def __init__(self, number: int) -> None:
        self.number = number
        super().__init__(self.name)

    @property
    def name(self) -> str:
        """``SIGINT`` or ``SIGTERM``."""
        return signal.Signals(self.number).name

    def final(self) -> BaseException:
        """What the command ends with: interrupted (130) by Ctrl-C, failed (1) by SIGTERM."""
        if self.number == signal.SIGINT:
            return KeyboardInterrupt("stopped by Ctrl-C; the robot was stopped")
        return RunFailed("stopped by SIGTERM; the robot was stopped")


class Interrupts:
    """Takes SIGINT and SIGTERM over while entered; only the main thread can.

    While ``deferred`` is set, the first signal waits for ``check``, which the loop calls at every
    beat, so that no command is cut in half. Otherwise, and for a second signal that finds the first
    still waiting, ``Interrupted`` is raised on the spot. Once the stop has begun (``stopping``),
    further signals are only counted: nothing may keep the robot from being stopped.
    """

    def __init__(self) -> None:
        self.deferred = False
        self.stopping = False
        self.signals: list[int] = []
        self._pending: int | None = None
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for number, previous in self._previous.items():
            signal.signal(number, previous)
        self._previous.clear()

    def check(self) -> None:
        """Raise what waits.

        Raises:
            Interrupted: a signal came.
        """
        if self._pending is not None and not self.stopping:
            number, self._pending = self._pending, None
            raise Interrupted(number)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.signals.append(number)
        if self.stopping:
            return
        if self.deferred and self._pending is None:
            self._pending = number
            return
        raise Interrupted(number)
