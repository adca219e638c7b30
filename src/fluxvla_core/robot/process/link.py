"""``Link``: one end of the memory that the main process and the control process share.

Two rings and two times. Each process stores the time at which it last ran; the other one sees
from it that a process was stopped, killed, or kept from running.
"""

from __future__ import annotations

import mmap
import os
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import Any

from fluxvla_core.robot.process.messages import Array, Message, decode, encode
from fluxvla_core.robot.process.ring import Ring

TO_CONTROL_BYTES = 1024 * 1024
"""Room for chunks and orders."""
TO_MAIN_BYTES = 1024 * 1024
"""Room for what happens: half a minute of commands."""
_TIMES = 64
SIZE = _TIMES + TO_CONTROL_BYTES + TO_MAIN_BYTES


def make_memory() -> int:
    """Memory for both ends, as ``allocate``; it is gone with the processes that have it."""
    return allocate("fluxvla-robot", SIZE)


def allocate(name: str, size: int) -> int:
    """A file descriptor of ``size`` bytes of memory without a file; ``name`` is for people.

    Raises:
        OSError: there is not so much memory. Pages that are missing later would crash a process.
    """
    descriptor = os.memfd_create(name)
    try:
        os.posix_fallocate(descriptor, 0, size)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


class Link:
    """One end; any thread may send, one thread receives.

    Args:
        descriptor: of ``make_memory``; remains open.
        control: whether this is the control process's end.
    """

    def __init__(self, descriptor: int, control: bool) -> None:
        memory = memoryview(mmap.mmap(descriptor, SIZE))
        self._times = memory[:_TIMES].cast("Q")
        middle = _TIMES + TO_CONTROL_BYTES
        rings = Ring(memory[_TIMES:middle]), Ring(memory[middle:])
        self._in, self._out = rings if control else rings[::-1]
        self._own, self._other = (0, 1) if control else (1, 0)
        self._lock = threading.Lock()
        self._waiting: deque[bytes] = deque()

    def try_send(self, kind: str, arrays: Sequence[Array] = (), **fields: Any) -> bool:
        """Send a message, or drop it if there is no room for it; whether it was sent."""
        self.mark_alive()
        data = encode(Message(kind, fields, arrays))
        with self._lock:
            return self._out.write(data)

    def send(self, kind: str, arrays: Sequence[Array] = (), **fields: Any) -> None:
        """Send a message that must arrive; if there is no room for it, ``flush`` sends it later.

        Returns at once in either case. Messages of ``send`` arrive in their order.
        """
        self.mark_alive()
        with self._lock:
            self._waiting.append(encode(Message(kind, fields, arrays)))
        self.flush()

    def flush(self) -> None:
        """Send the messages that wait for room, as far as there is room now."""
        with self._lock:
            while self._waiting and self._out.fits(self._waiting[0]):
                self._out.write(self._waiting.popleft())

    def receive(self) -> Message | None:
        """The oldest message that came; None if there is none."""
        data = self._in.read()
        return None if data is None else decode(data)

    @property
    def lost(self) -> int:
        """How many messages of the other end's ``try_send`` were dropped."""
        return self._in.dropped

    @property
    def read_by_other(self) -> bool:
        """Whether the other end took all that was sent to it."""
        return self._out.empty and not self._waiting

    def mark_alive(self) -> None:
        """Store the time: this process runs."""
        self._times[self._own] = time.monotonic_ns()

    def silent_s(self) -> float:
        """How many seconds the other process has not run; 0 before it ever did."""
        last = self._times[self._other]
        return (time.monotonic_ns() - last) * 1e-9 if last else 0.0


class SilenceWatch:
    """How long the other process has not run, as far as this one can blame it.

    Where the whole machine stands still, neither process runs, and this one may be the first to
    go on. So the longest pause of this one since the other ran is no silence. One pause only: a
    driver that blocks at every tick must not hide that the other process is dead.

    Args:
        link: this process's end.
        paused_s: two looks that are further apart show a pause.
    """

    def __init__(self, link: Link, paused_s: float) -> None:
        self._link, self._paused_s = link, paused_s
        self._looked = time.monotonic()
        self._pause = (self._looked, self._looked)

    def silent_s(self) -> float:
        """Look: seconds for which the other process has not run, less a pause of this one."""
        looked, self._looked = self._looked, time.monotonic()
        silent = self._link.silent_s()
        ran = self._looked - silent
        if self._looked - looked > self._paused_s:
            pauses = self._pause, (looked, self._looked)
            self._pause = max(pauses, key=lambda pause: _since(ran, pause))
        return max(silent - _since(ran, self._pause), 0.0)


def _since(at: float, pause: tuple[float, float]) -> float:
    """How many seconds of ``pause`` were after ``at``."""
    return max(pause[1] - max(pause[0], at), 0.0)
