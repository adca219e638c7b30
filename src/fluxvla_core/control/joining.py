"""How the chunks of a policy become one motion.

A ``Joiner`` is given chunks as they arrive and asked, for each command, where the arm should be.
Everything in it goes by time stamps, never by counts: a chunk is placed at the time of the
observation that it answers, so that a policy which is slow, or slow now and then, costs nothing but
the beginning of its chunk. ``control.joiners`` names them all.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.continuation import Continuation

Array = npt.NDArray[np.float64]
# A lockstep clock sums its steps, and the sum is rounded: half a microsecond is nothing.
_SAME_S = 5e-7


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

    def reaches(self, elapsed: float) -> bool:
        """Whether it says anything about ``elapsed`` seconds after its beginning."""
        # One part in a million of a keyframe's time is rounding, not an end.
        return elapsed <= self.seconds + 1e-6 / self.rate_hz

    def at(self, elapsed: float) -> Array:
        """``(D,)`` where it is after ``elapsed`` seconds; its first or last point outside it.

        As ``keyframes.sample`` has it. That works on the whole chunk, and numpy gives the
        interpreter up for arrays of that size: a thread that sends would have to get it again.
        """
        count = len(self.keyframes)
        position = min(max(elapsed * self.rate_hz, 0.0), float(count))
        before = min(int(position), max(count - 1, 0))
        share = position - before
        start = self.keyframes[before - 1] if before else self.anchor
        end = self.keyframes[before] if before < count else start
        point: Array = start * (1.0 - share) + end * share
        return point


class Ahead(ABC):
    """What is known about the motion under way when a policy is asked; it does not change."""

    @abstractmethod
    def seen_at(self, observed: float, horizon: int) -> Continuation | None:
        """For a chunk of ``horizon`` keyframes that answers an observation of time ``observed``.

        None if what is known ends before the first of them.
        """


class Joiner(ABC):
    """Chunks in, targets out. All calls come from the thread that sends."""

    streamed: ClassVar[bool] = True
    """Whether it is asked at every beat; otherwise a chunk's commands are played in one piece."""
    continues: ClassVar[bool] = False
    """Whether the policy is asked to go on from the chunk that is being played."""

    @abstractmethod
    def reset(self) -> None:
        """Forget every chunk: an episode begins."""

    @abstractmethod
    def add(self, chunk: Chunk, now: float) -> None:
        """A chunk arrived."""

    @abstractmethod
    def target(self, at: float) -> Array | None:
        """``(D,)`` where the arm should be at time ``at``; None when no chunk reaches so far."""

    @abstractmethod
    def wants_chunk(self, now: float) -> bool:
        """Whether the policy should be asked now, if it is free."""

    def ahead(self) -> Ahead | None:
        """What the policy is told to go on from; None for nothing."""
        return None


class Synchronous(Joiner):
    """One chunk after the other; while the policy thinks, the arm holds.

    A chunk's time starts when it arrives, so that none of it is skipped.
    """

    streamed: ClassVar[bool] = False

    def __init__(self) -> None:
        self._chunk: Chunk | None = None
        self._start = 0.0

    def reset(self) -> None:
        self._chunk = None

    def add(self, chunk: Chunk, now: float) -> None:
        self._chunk, self._start = chunk, now

    def target(self, at: float) -> Array | None:
        chunk, elapsed = self._chunk, at - self._start
        return chunk.at(elapsed) if chunk is not None and chunk.reaches(elapsed) else None

    def wants_chunk(self, now: float) -> bool:
        return self._chunk is None or now - self._start >= self._chunk.seconds - _SAME_S


class Streamed(Joiner):
    """What joiners have in common that ask for the next chunk while one is being played.

    Args:
        every_s: how far apart the observations that are answered should be, at least; a slow
            policy makes it more. 0 asks as soon as the policy is free.
    """

    def __init__(self, every_s: float = 0.0) -> None:
        self.every_s = every_s
        self._observed: float | None = None

    def reset(self) -> None:
        self._observed = None

    def add(self, chunk: Chunk, now: float) -> None:
        self._observed = max(chunk.observed, self._observed or chunk.observed)

    def wants_chunk(self, now: float) -> bool:
        return self._observed is None or now - self._observed >= self.every_s - _SAME_S


class LatestOnly(Streamed):
    """The newest chunk alone, on the time of its observation: what is past in it is left out.

    The way from the old chunk to the new one is the limiter's.
    """

    def __init__(self, every_s: float = 0.0) -> None:
        super().__init__(every_s)
        self._chunk: Chunk | None = None

    def reset(self) -> None:
        super().reset()
        self._chunk = None

    def add(self, chunk: Chunk, now: float) -> None:
        super().add(chunk, now)
        if self._chunk is None or chunk.observed >= self._chunk.observed:
            self._chunk = chunk

    def target(self, at: float) -> Array | None:
        chunk = self._chunk
        if chunk is None or not chunk.reaches(at - chunk.observed):
            return None
        return chunk.at(at - chunk.observed)
