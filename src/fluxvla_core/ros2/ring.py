"""The newest messages of one stream, with the time that each arrived."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass
from typing import Any

STEP = 1.0
"""Seconds by which a stamp must jump against the receipt times to be a step of the sender's clock,
and not a message that was overtaken."""


@dataclass(frozen=True)
class Received:
    """One message.

    ``receipt`` is seconds on this process's monotonic clock; ``stamp`` seconds on the sender's
    clock, None if the message bears none.
    """

    receipt: float
    stamp: float | None
    message: Any


class Ring:
    """At most ``depth`` messages, oldest dropped first, in the order of the sender's stamps.

    A message that another overtook, or that comes twice, says nothing new; it is counted and
    dropped, so that a driver repeating its last picture counts as silent. When the sender's clock
    steps (a restart, NTP, a simulation that begins again), what came before the step is dropped,
    because it cannot be compared with what comes after. Any thread may call anything.
    """

    def __init__(self, depth: int) -> None:
        if depth < 1:
            raise ValueError(f"a ring holds at least 1 message, got depth {depth}")
        self._items: deque[Received] = deque(maxlen=depth)
        self._lock = threading.Lock()
        self._before: tuple[float, float | None] = (0.0, None)
        self.received = 0
        self.duplicates = 0
        self.overtaken = 0
        self.clock_steps = 0
        self.stepped_at: float | None = None

    def add(self, receipt: float, stamp: float | None, message: Any) -> bool:
        """Keep the message if it is news; returns whether it is."""
        with self._lock:
            self.received += 1
            before, self._before = self._before, (receipt, stamp)
            newest = self._items[-1].stamp if self._items else None
            if stamp is not None and newest is not None and before[1] is not None:
                if stamp in (newest, before[1]):
                    self.duplicates += 1
                    return False
                # A gap in the stream moves both clocks alike and is no step.
                if abs((stamp - before[1]) - (receipt - before[0])) > STEP:
                    self.clock_steps += 1
                    self.stepped_at = receipt
                    self._items.clear()
                elif stamp < newest:
                    self.overtaken += 1
                    return False
            self._items.append(Received(receipt, stamp, message))
            return True

    def newest(self) -> Received | None:
        """The newest message, None before the first."""
        with self._lock:
            return self._items[-1] if self._items else None

    def items(self) -> tuple[Received, ...]:
        """All messages, newest last."""
        with self._lock:
            return tuple(self._items)


def stamp_of(message: Any) -> float | None:
    """Seconds of ``header.stamp``; None without a header, or where the sender left it at zero."""
    header = getattr(message, "header", None)
    if header is None:
        return None
    seconds = float(header.stamp.sec) + header.stamp.nanosec * 1e-9
    return seconds or None
