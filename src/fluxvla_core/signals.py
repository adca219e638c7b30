"""Answering signals for a while: what a robot's loop, a training and the command line share."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

Handler = Callable[[int, "FrameType | None"], None]


@contextmanager
def handling(handler: Handler, *numbers: int) -> Iterator[None]:
    """``handler`` answers these signals while this is entered; then whoever did before.

    Only the main thread can arrange that: in another one nothing changes, and whoever runs the
    main thread decides.
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
