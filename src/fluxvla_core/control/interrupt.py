"""Signals while a robot moves: Ctrl-C, SIGTERM, a closed terminal stop it at the next tick."""

from __future__ import annotations

import signal
import time
from contextlib import ExitStack
from types import FrameType, TracebackType

from fluxvla_core.errors import RunFailed
from fluxvla_core.signals import handling, requests_to_stop

IMPATIENT_S = 0.5


class Interrupted(BaseException):
    """A signal asked the run to end. Not an ``Exception``: nobody's ``except`` may swallow it."""

    def __init__(self, number: int) -> None:
        self.number = number
        super().__init__(self.name)

    @property
    def name(self) -> str:
        """The signal's name, for example ``SIGINT``."""
        return signal.Signals(self.number).name

    def final(self, failure: str | None = None) -> BaseException:
        """The error that ends the command: interrupted (130) after Ctrl-C, else failed (1).

        Args:
            failure: what went wrong with the robot's stop; None if it was stopped.
        """
        if self.number == signal.SIGINT:
            return KeyboardInterrupt(f"stopped by Ctrl-C; {stop_outcome(failure)}")
        return RunFailed(f"stopped by {self.name}; {stop_outcome(failure)}", reason="stopped")


def stop_outcome(failure: str | None) -> str:
    """Outcome of a robot's stop, for a message; ``failure``: what went wrong with it, or None."""
    return "the robot was stopped" if failure is None else f"stopping the robot failed: {failure}"


class Interrupts:
    """Takes over SIGINT, SIGTERM, SIGHUP, SIGQUIT and SIGTSTP while entered; only the main thread
    can.

    SIGHUP comes when the terminal goes away, with the network that a person is logged in through:
    by default it would end the process with the arm in motion. ``nohup`` keeps it from coming.
    Ctrl-\\ (SIGQUIT) would end it as well, and Ctrl-Z (SIGTSTP) pause it, both with the arm in
    motion and nobody who watches it.

    While ``deferred`` is set, the first signal waits for ``check``, which the loop calls at every
    tick, so that no command is cut in half. Otherwise, and for another signal where no tick came
    for ``IMPATIENT_S`` after the first, ``Interrupted`` is raised on the spot. Once the stop has
    begun, or the record of an episode is being finished (``stopping``), further signals are only
    counted: nothing may keep the robot from being stopped, or the record from being whole.
    """

    def __init__(self) -> None:
        self.deferred = False
        self.stopping = False
        self.signals: list[int] = []
        self._pending: int | None = None
        self._since = 0.0
        self._taken = ExitStack()

    def __enter__(self) -> Interrupts:
        numbers = requests_to_stop()
        for name in ("SIGQUIT", "SIGTSTP"):
            number = getattr(signal, name, None)  # not every system has them
            if number is not None and signal.getsignal(number) != signal.SIG_IGN:
                numbers.append(number)
        self._taken.enter_context(handling(self.on_signal, *numbers))
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._taken.close()

    def check(self) -> None:
        """Raise what waits.

        Raises:
            Interrupted: a signal came.
        """
        if self._pending is not None and not self.stopping:
            number, self._pending = self._pending, None
            raise Interrupted(number)

    def resume(self) -> None:
        """Handle signals again, after ``stopping`` was set; the run continues.

        Raises:
            Interrupted: one came meanwhile.
        """
        self.stopping = False
        if self.signals:
            raise Interrupted(self.signals[-1])

    def on_signal(self, number: int, frame: FrameType | None) -> None:
        """A signal came; the handler of all of them."""
        self.signals.append(number)
        if self.stopping:
            return
        now = time.monotonic()
        if self.deferred and self._pending is None:
            self._pending, self._since = number, now
            return
        # Two at once are one wish: a terminal that closes sends several.
        if self.deferred and now - self._since < IMPATIENT_S:
            return
        raise Interrupted(number)
