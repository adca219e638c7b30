"""Answering signals: what a robot's loop, a training, its processes and the command line share."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
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

    SIGHUP comes when the terminal goes away, with the network that a person is logged in through;
    ``nohup`` starts a process that ignores it, and so it shall stay.
    """
    numbers: list[int] = [signal.SIGINT, signal.SIGTERM]
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    return numbers


def leave_stopping_to_the_parent() -> None:
    """Let this worker process end when its parent ends it, or is gone, and of no request to stop.

    A terminal, a scheduler and torch's agent send theirs to whole groups of processes: the parent
    decides what it means, and may need the worker until it has. It ends one that does not end by
    itself with SIGKILL.
    """
    from multiprocessing import parent_process
    from multiprocessing.connection import wait

    numbers = requests_to_stop()
    for number in numbers:
        signal.signal(number, signal.SIG_IGN)
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
    """Requests to stop wait while this is entered, in processes that are started in it as well.

    Those let them in by :func:`leave_stopping_to_the_parent`.

    Args:
        start_method: multiprocessing's, of these processes.
    """
    if start_method != "fork":
        from multiprocessing import resource_tracker

        # It would be started with the first of them, and lets everything in again at that.
        resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, requests_to_stop())
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def handling(handler: Handler, *numbers: int) -> Iterator[None]:
    """``handler`` answers these signals while this is entered; then the previous handlers do.

    Only the main thread can arrange that: in another one nothing changes, and the main
    thread's handlers stay.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, before in previous.items():
            signal.signal(number, before)
