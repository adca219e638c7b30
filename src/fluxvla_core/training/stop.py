"""Stopping on SIGINT, SIGTERM and SIGHUP: all ranks at the same step, with a checkpoint saved."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from contextlib import ExitStack
from types import FrameType

from fluxvla_core.errors import FluxError, RunFailed
from fluxvla_core.signals import handling, requests_to_stop
from fluxvla_core.training.distributed import World, all_reduce_max, run_on_rank0

NOTICE_S = 0.5
"""Seconds within which ranks hear of each other's signals, if steps are shorter."""
_SECOND_S = 1.0
_CHECK_FAILED = 1 << 16  # no signal's number


class StopRequest:
    """Notices SIGINT, SIGTERM and SIGHUP while it is entered as a context manager.

    The first signal asks for a stop at the end of a step, or of a batch that is validated; a second
    SIGINT more than a second later ends at once (a terminal and a launcher may both pass on the
    first one). Ranks exchange their signals every few steps, often enough to notice within about
    half a second.

    Args:
        check: on the first rank, raises a FluxError where all are to stop at once, with nothing
            saved; called about twice a second.
    """

    def __init__(self, world: World, check: Callable[[], None] | None = None) -> None:
        self._world = world
        self._check = check
        self._checked = time.monotonic()
        self._process = os.getpid()
        self._signal = 0
        self._since = 0.0
        self._taken = ExitStack()
        self._every = 1

    def __enter__(self) -> StopRequest:
        self._taken.enter_context(handling(self._handle, *requests_to_stop()))
        return self

    def __exit__(self, *details: object) -> None:
        self._taken.close()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if os.getpid() != self._process:
            # A process that was forked from here just now: this one decides.
            return
        if number == signal.SIGINT and self._signal and time.monotonic() - self._since > _SECOND_S:
            raise KeyboardInterrupt
        if not self._signal:
            self._signal, self._since = number, time.monotonic()

    @property
    def received(self) -> int:
        """The first signal that this rank got, or 0."""
        return self._signal

    def set_interval(self, step_time: float) -> None:
        """Choose every how many steps ranks synchronise; ``step_time`` (s), equal on all ranks."""
        self._every = max(1, int(NOTICE_S / step_time)) if step_time > 0 else 1

    def is_sync_step(self, step: int) -> bool:
        """Whether ranks exchange their signals after ``step``."""
        return self._world.size == 1 or step % self._every == 0

    def poll(self, step: int) -> int:
        """The signal that some rank got, or 0; every rank gets the same answer."""
        return self.poll_now() if self.is_sync_step(step) else 0

    def poll_now(self, check: bool = False) -> int:
        """As :meth:`poll`, at any step: all ranks call it at the same place.

        Args:
            check: call ``check`` even if that was done a moment ago.

        Raises:
            FluxError: the first rank's check failed; on every rank.
        """
        error = self._check_error(check)
        number = all_reduce_max(self._world, self._signal if error is None else _CHECK_FAILED)
        if number == _CHECK_FAILED:
            run_on_rank0(self._world, lambda: _raise(error))
        return number

    def _check_error(self, force: bool) -> FluxError | None:
        if self._check is None or not (force or time.monotonic() - self._checked >= NOTICE_S):
            return None
        self._checked = time.monotonic()
        try:
            self._check()
        except FluxError as error:
            return error
        return None


def _raise(error: FluxError | None) -> str:
    assert error is not None, "only the first rank checks"
    raise error


def stopped(number: int, place: str) -> BaseException:
    """The exception that ends a run that was asked to stop, and saved.

    SIGINT ends as an interrupted command does (exit code 130), the others as one that could not
    finish (1): a scheduler that restarts failed jobs then restarts this one.
    """
    if number == signal.SIGINT:
        return KeyboardInterrupt(place)
    stop: FluxError = RunFailed(
        f"training was stopped by {signal.Signals(number).name}",
        cause=f"all is saved: {place}",
        next="run the same command again with --resume auto",
        reason="stopped",
    )
    return stop
