"""Stalls of the machine, for tests with deadlines: the root conftest runs those again.

Shared machines stand still for a second at times. A robot that is stopped then is stopped rightly,
and a test of something else has failed without proving anything.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from contextlib import suppress

STALL_S = 0.1
"""Seconds without a chance to run that count as a stall."""
# A process of its own, whose threads wait for nobody's GIL; a single processor may stand still too.
_PROGRAM = f"""
import os, threading, time

parent = os.getppid()

def watch(processor):
    os.sched_setaffinity(0, [processor])
    last = time.monotonic()
    os.write(1, b"\\n")
    while os.getppid() == parent:
        time.sleep(0.02)
        now = time.monotonic()
        if now - last > {STALL_S}:
            os.write(1, f"{{last}} {{now}}\\n".encode())
        last = now

for processor in os.sched_getaffinity(0):
    threading.Thread(target=watch, args=[processor]).start()
"""


class StallWatch:
    """Watches, in a process of its own, whether this machine stands still."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE
        )
        assert self._process.stdout is not None
        self._pipe = self._process.stdout.fileno()
        os.read(self._pipe, 1)  # it watches
        os.set_blocking(self._pipe, False)
        self._text = b""

    @property
    def pid(self) -> int:
        """The watching process's id."""
        return self._process.pid

    def longest_s(self, since: float) -> float:
        """The longest stall that ended after ``since`` (``time.monotonic()``), in seconds."""
        time.sleep(2 * STALL_S)  # for the one that ends just now
        with suppress(BlockingIOError):  # that was all
            while data := os.read(self._pipe, 65536):
                self._text += data
        *lines, self._text = self._text.split(b"\n")
        stalls = [[float(word) for word in line.split()] for line in lines if line]
        return max((ended - began for began, ended in stalls if ended > since), default=0.0)

    def close(self) -> None:
        """End the watching process."""
        self._process.kill()
        self._process.communicate()
