"""How the chunks of a policy become one motion.

A ``Joiner`` is given chunks as they arrive and asked, for each command, what the arm should be at.
``Synchronous`` plays a chunk, then lets the arm hold until the next one is there. ``LatestOnly``
plays each chunk on the time of its observation and replaces the one before as soon as a newer one
arrives. Joiners that blend chunks have the same two calls.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from fluxvla_core.control.keyframes import sample

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Chunk:
    """A policy's answer and what it was an answer to.

    Args:
        keyframes: ``(T, D)`` targets; those that shall be played.
        rate_hz: keyframes a second.
        observed: when the observation was made, on the loop's clock.
        anchor: ``(D,)`` the command that the arm had then.
    """

    keyframes: Array
    rate_hz: float
    observed: float
    anchor: Array

    @property
    def seconds(self) -> float:
        """How long it lasts."""
        return len(self.keyframes) / self.rate_hz


class Joiner(Protocol):
    """Chunks in, targets out."""

    def reset(self) -> None:
        """Forget every chunk: an episode begins."""

    def add(self, chunk: Chunk, now: float) -> None:
        """A chunk arrived."""

    def target(self, at: float) -> Array | None:
        """``(D,)`` where the arm should be at time ``at``; None when no chunk reaches so far."""

    def wants_chunk(self, now: float) -> bool:
        """Whether the policy should be asked now, if it is free."""


class Synchronous:
    """One chunk after the other; while the policy thinks, the arm holds.

    A chunk's time starts when it arrives, so that none of it is skipped.
    """

    def __init__(self) -> None:
        self._chunk: Chunk | None = None
        self._start = 0.0

    def reset(self) -> None:
        self._chunk = None

    def add(self, chunk: Chunk, now: float) -> None:
        self._chunk, self._start = chunk, now

    def target(self, at: float) -> Array | None:
        return _at(self._chunk, at - self._start)

    def wants_chunk(self, now: float) -> bool:
        # Half a microsecond: a lockstep clock sums its steps, and the sum is rounded.
        return self._chunk is None or now - self._start >= self._chunk.seconds - 5e-7


class LatestOnly:
    """The newest chunk alone, on the time of its observation: what is past in it is left out.

    The way from the old chunk to the new one is the limiter's.
    """

    def __init__(self) -> None:
        self._chunk: Chunk | None = None

    def reset(self) -> None:
        self._chunk = None

    def add(self, chunk: Chunk, now: float) -> None:
        if self._chunk is None or chunk.observed >= self._chunk.observed:
            self._chunk = chunk

    def target(self, at: float) -> Array | None:
        return _at(self._chunk, at - self._chunk.observed) if self._chunk is not None else None

    def wants_chunk(self, now: float) -> bool:
        return True


def _at(chunk: Chunk | None, elapsed: float) -> Array | None:
    # One part in a million of a keyframe's time is rounding, not an end.
    if chunk is None or elapsed > chunk.seconds + 1e-6 / chunk.rate_hz:
        return None
    point: Array = sample(chunk.anchor, chunk.keyframes, chunk.rate_hz, [elapsed])[0]
    return point
