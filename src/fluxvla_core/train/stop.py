"""Being asked to stop: all ranks leave at the same step, with a checkpoint behind them."""

from __future__ import annotations

import os
import signal
import time
from contextlib import ExitStack
from types import FrameType, TracebackType

from fluxvla_core.errors import FluxError, RunFailed
from fluxvla_core.signals import handling
from fluxvla_core.train.distributed import World, agree

NOTICE_S = 0.5
"""Seconds within which ranks hear of each other's signals, if steps are shorter."""
_SECOND_S = 1.0


class StopRequest:
    """Notices SIGINT and SIGTERM while it is entered as a context manager.

    The first signal asks for a stop at the end of a step, or of a batch that is validated; a second
    SIGINT more than a second later ends at once (a terminal and a launcher may both pass on the
    first one). Ranks compare notes every few steps, often enough to notice within about half a
    second.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        self._process = os.getpid()
        self._signal = 0
        self._since = 0.0
        self._taken = ExitStack()
        self._every = 1

    def __enter__(self) -> StopRequest:
        self._taken.enter_context(handling(self._handle, signal.SIGINT, signal.SIGTERM))
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._taken.close()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if os.getpid() != self._process:
            # A data worker, forked from here: it ends when this process is done with it. A
            # signal to the whole group must not take the data away from the last step.
            return
        if number == signal.SIGINT and self._signal and time.monotonic() - self._since > _SECOND_S:
            raise KeyboardInterrupt
        if not self._signal:
            self._signal, self._since = number, time.monotonic()

    def pace(self, step_time: float) -> None:
        """Choose how often ranks compare notes; ``step_time`` (s) must be equal on all ranks."""
        self._every = max(1, int(NOTICE_S / step_time)) if step_time > 0 else 1

    def due(self, step: int) -> bool:
        """Whether ranks compare notes after ``step``."""
        return self._world.size == 1 or step % self._every == 0

    def wanted(self, step: int) -> int:
        """The signal that some rank got, or 0; every rank gets the same answer."""
        return self.asked() if self.due(step) else 0

    def asked(self) -> int:
        """As :meth:`wanted`, at once: all ranks call it at the same place."""
        return agree(self._world, self._signal)


def stopped(number: int, place: str) -> BaseException:
    """What a run that was asked to stop, and saved, ends with.

    SIGINT ends as an interrupted command does (exit code 130), SIGTERM as one that could not
    finish (1): whoever restarts failed jobs then restarts this one.
    """
    if number == signal.SIGINT:
        return KeyboardInterrupt(place)
    stop: FluxError = RunFailed(
        "training was stopped by SIGTERM",
        cause=f"all is saved: {place}",
        next="go on with the same command and --resume auto",
    )
    return stop
