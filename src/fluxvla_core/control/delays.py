"""Timing of calls: which one, of the operator, the policy or the machine, kept a robot waiting."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

# Calls that are shorter keep nobody waiting, and are not remembered.
_LEAST_S = 0.005
_POLL_S = 0.05
# A look that comes this much too late shows that the process stood still, if it computed for less
# than this share of that. While native code computes without releasing the GIL, looks come
# late as well, but the process is busy: that is not the machine's doing.
_STALL_S, _BUSY_SHARE = 0.2, 0.25
_STALLS_KEPT = 32


@dataclass(frozen=True)
class DelaySource:
    """Something that may be slow, and is named when a robot waits for it.

    Args:
        name: for messages, for example ``Arm.get_frame()``.
        cause, next: the likely cause and what to do, as in a ``FluxError``.
    """

    name: str
    cause: str
    next: str


POLICY = DelaySource(
    "the policy",
    "the policy hangs, or is slower than its chunks are long",
    "play longer chunks (execute_horizon), or use a faster policy",
)
MACHINE = DelaySource(
    "this machine",
    "the process was paused, other programs took the processors, or native code held the GIL; "
    "the robot and the policy were not asked meanwhile",
    "lighten the load of this machine, or give this process a higher priority",
)


def robot_call(name: str) -> DelaySource:
    """A call of an operator, for example ``Arm.get_frame()``."""
    return DelaySource(
        name,
        "the robot, or a camera that is read in this call, does not answer",
        "look at the robot's driver, its cameras and their cables",
    )


@dataclass(frozen=True)
class _Span:
    source: DelaySource
    began: float
    ended: float


@dataclass(frozen=True)
class _Look:
    """What the watching thread found when it looked last; replaced as a whole, so that another
    thread counts no pause twice.

    Args:
        at: its time.
        computed: the processor time of this process by then, in seconds.
        stalls: the latest times in which the process stood still.
    """

    at: float
    computed: float
    stalls: tuple[tuple[float, float], ...]

    def stalls_until(self, now: float) -> tuple[tuple[float, float], ...]:
        """With the one that ends just now, which the watching thread may not have seen yet."""
        lost = now - self.at - _POLL_S
        busy = time.process_time() - self.computed
        stalled = lost > _STALL_S and busy < _BUSY_SHARE * lost
        return (*self.stalls, (now - lost, now)) if stalled else self.stalls


class DelayMonitor:
    """Measures how long calls take, in any thread, and when this process stood still.

    Times are ``time.monotonic()``: also in a simulation, whose own time stands still in a call.
    """

    def __init__(self) -> None:
        self._spans: deque[_Span] = deque(maxlen=1024)
        self._open: dict[int, tuple[DelaySource, float]] = {}
        self._look: _Look | None = None

    @contextmanager
    def of(self, source: DelaySource) -> Iterator[None]:
        """A call of ``source`` is under way in this thread while this is entered."""
        thread, began = threading.get_ident(), time.monotonic()
        self._open[thread] = source, began
        try:
            yield
        finally:
            del self._open[thread]
            ended = time.monotonic()
            if ended - began > _LEAST_S:
                self._spans.append(_Span(source, began, ended))

    def longest(self, since: float) -> tuple[DelaySource, float]:
        """The source that took the most time since then, in seconds; the policy if none did."""
        now = time.monotonic()
        stalls = self._stalls_until(now)
        spent = {POLICY: 0.0, MACHINE: sum(_overlap(b, e, since, now) for b, e in stalls)}
        under_way = [_Span(source, began, now) for source, began in self._open.copy().values()]
        for span in (*self._spans, *under_way):
            began, ended = max(span.began, since), min(span.ended, now)
            # Who was in a call while nothing ran at all is not to blame for it.
            paused = sum(_overlap(b, e, began, ended) for b, e in stalls)
            spent[span.source] = spent.get(span.source, 0.0) + max(ended - began, 0.0) - paused
        source = max(spent, key=spent.__getitem__)
        return source, spent[source]

    def stood_still(self, since: float) -> float:
        """Seconds since then in which this process did not run."""
        now = time.monotonic()
        return sum(_overlap(b, e, since, now) for b, e in self._stalls_until(now))

    def under_way(self) -> list[str]:
        """The calls that have not returned."""
        return [source.name for source, _ in self._open.copy().values()]

    @contextmanager
    def watched(self, warn: Callable[[str], None], after_s: float) -> Iterator[None]:
        """Watch from a thread of its own while this is entered.

        A call that keeps the thread which entered this for longer than ``after_s`` is reported by
        ``warn``, once for each source: nobody else could say so.
        """
        ended, watched = threading.Event(), threading.get_ident()

        def watch() -> None:
            warned: set[DelaySource] = set()
            self._look = look = _Look(time.monotonic(), time.process_time(), ())
            while not ended.wait(_POLL_S):
                now = time.monotonic()
                stalls = look.stalls_until(now)[-_STALLS_KEPT:]
                self._look = look = _Look(now, time.process_time(), stalls)
                source, began = self._open.get(watched, (None, now))
                if source is not None and source not in warned and now - began > after_s:
                    warned.add(source)
                    warn(f"{source.name} has not returned for {now - began:.1f} s: {source.cause}")

        thread = threading.Thread(target=watch, name="fluxvla-watch", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()
            self._look = None

    def _stalls_until(self, now: float) -> tuple[tuple[float, float], ...]:
        look = self._look
        return () if look is None else look.stalls_until(now)


def _overlap(a: float, b: float, c: float, d: float) -> float:
    return max(0.0, min(b, d) - max(a, c))
