"""Signal handling that robots, training, worker processes and the command line share."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from types import FrameType

Handler = Callable[[int, "FrameType | None"], None]


def signal_name(number: int) -> str:
    """The name of a signal, for example ``SIGKILL``; most real-time signals have only a number."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def requests_to_stop() -> list[int]:
    """The signals that ask a process to stop: SIGINT, SIGTERM, and SIGHUP unless it is ignored.

    SIGHUP comes when the terminal, or the network connection to it, is closed; a process started
    with ``nohup`` ignores it, and continues to.
    """
    numbers: list[int] = [signal.SIGINT, signal.SIGTERM]
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    return numbers


def leave_stopping_to_the_parent() -> None:
    """Ignore requests to stop in this worker process, and end it when its parent is gone.

    Terminals, schedulers and torch's agent signal whole groups of processes. The parent decides
    what follows, may need the worker until then, and ends it with SIGKILL if necessary.
    """
    from multiprocessing import parent_process
    from multiprocessing.connection import wait

    numbers = requests_to_stop()
    ignore(numbers)
    # The parent may have held them back until they are ignored.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, numbers)
    parent = parent_process()
    assert parent is not None, "runs in a worker"

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, name="fluxvla-parent-watch", daemon=True).start()


@contextmanager
def held_back(start_method: str) -> Iterator[None]:
    """Block requests to stop inside, also in processes that are started inside.

    Those unblock them in :func:`leave_stopping_to_the_parent`.

    Args:
        start_method: of these processes (multiprocessing).
    """
    if start_method != "fork":
        from multiprocessing import resource_tracker

        # It would start with the first process, and unblock the signals.
        resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, requests_to_stop())
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def ignore(numbers: Iterable[int]) -> None:
    """Ignore these signals from now on, also after a ``handling`` that this is called in.

    Only the main thread can set handlers: in another one nothing changes.
    """
    if threading.current_thread() is threading.main_thread():
        for number in numbers:
            signal.signal(number, signal.SIG_IGN)


@contextmanager
def handling(handler: Handler, *numbers: int) -> Iterator[None]:
    """Handle these signals with ``handler`` inside; the previous handlers are restored, except
    those of signals that are ignored by then.

    Only the main thread can set handlers: in another one nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, before in previous.items():
            if signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, before)
