"""Fault injection: a driver's messages frozen, lost, late or wrong, for simulations and tests."""

from __future__ import annotations

import copy
import heapq
import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fluxvla_core.errors import UsageError

MODES: Mapping[str, str] = {
    "freeze": "the last message is sent again and again, stamp and all",
    "drop": "a share of the messages (amount, 0 to 1) is not sent",
    "delay": "every message is sent late (amount, seconds), with its true stamp",
    "nan": "every number is NaN",
    "duplicate": "every message is sent twice",
    "out_of_order": "every second message is sent after the one that follows it",
    "clock": "stamps are off by an amount of seconds, as after a step of the clock",
}
AMOUNTS = ("drop", "delay", "clock")
_NUMBERS = ("position", "velocity", "effort", "data")


@dataclass(frozen=True)
class Fault:
    """A fault of one stream; ``MODES`` says what ``amount`` means."""

    mode: str
    amount: float = 1.0

    @classmethod
    def parse(cls, text: str) -> tuple[str, Fault]:
        """``STREAM=MODE`` or ``STREAM=MODE:AMOUNT``, as on a command line.

        Raises:
            UsageError: another form, an unknown mode, or an amount that means nothing.
        """
        stream, _, rest = text.partition("=")
        mode, _, amount = rest.partition(":")
        if not stream or mode not in MODES:
            raise UsageError(
                f"{text!r} is no fault; write STREAM=MODE or STREAM=MODE:AMOUNT "
                f"with a mode of {', '.join(MODES)}"
            )
        try:
            value = float(amount or 1.0)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise UsageError(f"{text!r}: {amount!r} is no number")
        if mode == "drop" and not 0 < value <= 1:
            raise UsageError(f"{text!r}: the share that is dropped is above 0 and at most 1")
        if mode == "delay" and value <= 0:
            raise UsageError(f"{text!r}: a delay is a positive number of seconds")
        if amount and mode not in AMOUNTS:
            raise UsageError(f"{text!r}: {mode} takes no amount; {', '.join(AMOUNTS)} do")
        return stream, cls(mode, value)


class Faults:
    """The streams that have a fault, and what becomes of their messages."""

    def __init__(self) -> None:
        self._faults: dict[str, Fault] = {}
        self._last: dict[str, Any] = {}
        self._kept: dict[str, Any] = {}
        self._share: dict[str, float] = {}

    def set(self, stream: str, fault: Fault) -> None:
        """From now on ``stream`` has this fault and no other."""
        self._faults[stream] = fault
        self._kept.pop(stream, None)
        self._share[stream] = 0.0

    def clear(self, stream: str) -> None:
        """End the fault of ``stream``."""
        self._faults.pop(stream, None)

    def apply(self, stream: str, message: Any) -> list[tuple[float, Any]]:
        """The messages that are sent in place of ``message``, in order, each with its delay (s)."""
        fault = self._faults.get(stream)
        if fault is None:
            self._last[stream] = message
            return [(0.0, message)]
        if fault.mode == "freeze":
            return [(0.0, self._last.setdefault(stream, message))]
        if fault.mode == "drop":
            # Spread evenly and without chance, so that a run can be repeated.
            self._share[stream] += fault.amount
            dropped = self._share[stream] >= 1.0
            self._share[stream] -= float(dropped)
            return [] if dropped else [(0.0, message)]
        if fault.mode == "delay":
            return [(fault.amount, message)]
        if fault.mode == "duplicate":
            return [(0.0, message), (0.0, message)]
        if fault.mode == "out_of_order":
            before = self._kept.pop(stream, None)
            if before is None:
                self._kept[stream] = message
                return []
            return [(0.0, message), (0.0, before)]
        return [(0.0, _changed(message, fault))]


class Outbox:
    """Publishes messages when they are due, after what ``faults`` does to them.

    One thread uses one outbox; several may share the faults.
    """

    def __init__(self, faults: Faults) -> None:
        self._faults = faults
        self._waiting: list[tuple[float, int, Any, Any]] = []
        self._ticket = itertools.count()

    @property
    def next_due(self) -> float:
        """When ``flush`` has something to do again, in seconds; infinity if nothing waits."""
        return self._waiting[0][0] if self._waiting else math.inf

    def put(self, stream: str, publisher: Any, message: Any, now: float) -> None:
        """Queue the message for ``publisher``, changed by the stream's fault."""
        for delay, changed in self._faults.apply(stream, message):
            heapq.heappush(self._waiting, (now + delay, next(self._ticket), publisher, changed))

    def flush(self, now: float) -> None:
        """Publish what is due."""
        while self._waiting and self._waiting[0][0] <= now:
            _, _, publisher, message = heapq.heappop(self._waiting)
            publisher.publish(message)

    def clear(self) -> None:
        """Forget what waits."""
        self._waiting.clear()


def _changed(message: Any, fault: Fault) -> Any:
    changed = copy.deepcopy(message)
    if fault.mode == "clock":
        stamp = changed.header.stamp
        nanoseconds = stamp.sec * 10**9 + stamp.nanosec + round(fault.amount * 1e9)
        stamp.sec, stamp.nanosec = divmod(max(nanoseconds, 0), 10**9)
        return changed
    for name in _NUMBERS:
        values = getattr(changed, name, None)
        if isinstance(values, float):
            setattr(changed, name, math.nan)
        elif values is not None and len(values) and isinstance(values[0], float):
            setattr(changed, name, [math.nan] * len(values))
    return changed
