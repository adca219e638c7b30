"""A policy's action chunks in time, and what joins them into one motion.

A chunk holds targets at ``rate_hz`` (10 Hz is common), a robot takes commands at ``control_hz`` (50
Hz for ALOHA): between two keyframes the motion is linear. Keyframe ``j`` is to be reached
``(j + 1) / rate_hz`` seconds after the observation; before it, the arm is where ``previous`` says.

A ``ChunkJoiner`` is given chunks as they arrive and asked, for each command, where the arm should
be. Everything in it goes by time stamps, never by counts: a chunk is placed at the time of the
observation that it answers, so that a policy which is slow, or slow now and then, costs nothing but
the beginning of its chunk. ``robot.joiners`` has them all.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.policy import Continuation

Array = npt.NDArray[np.float64]


def interpolate(
    previous: npt.ArrayLike, chunk: npt.ArrayLike, rate_hz: float, control_hz: float
) -> Array:
    """Commands at ``control_hz`` along straight lines from ``previous`` through all keyframes.

    Args:
        previous: ``(D,)`` where the arm is commanded to be at the observation.
        chunk: ``(T, D)`` targets, one every ``1 / rate_hz`` seconds.
        rate_hz: keyframes a second.
        control_hz: commands a second.

    Returns:
        ``(N, D)`` float64; command ``k`` is for ``(k + 1) / control_hz`` seconds after the
        observation, and ``N = floor(T * control_hz / rate_hz)``, at least 1 when ``T`` is.

    Raises:
        ValueError: shapes do not fit, or a rate is not positive.
    """
    keyframes = np.asarray(chunk, dtype=np.float64)
    if rate_hz <= 0 or control_hz <= 0:
        raise ValueError(f"rates must be positive, got {rate_hz} Hz and {control_hz} Hz")
    if keyframes.ndim != 2:
        raise ValueError(f"a chunk has shape (T, D), got {keyframes.shape}")
    # The small term keeps 3 keyframes at 10 Hz from becoming 14 commands at 50 Hz.
    count = int(np.floor(len(keyframes) * control_hz / rate_hz + 1e-6))
    count = max(count, min(len(keyframes), 1))
    return sample(previous, keyframes, rate_hz, (np.arange(count) + 1.0) / control_hz)


def sample(
    previous: npt.ArrayLike, chunk: npt.ArrayLike, rate_hz: float, elapsed: npt.ArrayLike
) -> Array:
    """Where the lines through ``previous`` and the keyframes are after ``elapsed`` seconds.

    Before 0 it is ``previous``, after the last keyframe the last keyframe.

    Args:
        previous: ``(D,)``.
        chunk: ``(T, D)``.
        rate_hz: keyframes a second.
        elapsed: ``(N,)`` seconds since the observation.

    Returns:
        ``(N, D)`` float64.

    Raises:
        ValueError: shapes do not fit.
    """
    start = np.asarray(previous, dtype=np.float64)
    keyframes = np.asarray(chunk, dtype=np.float64)
    if start.ndim != 1 or keyframes.ndim != 2 or keyframes.shape[1] != start.shape[0]:
        raise ValueError(
            f"previous of shape (D,) and chunk of shape (T, D) are needed, "
            f"got {start.shape} and {keyframes.shape}"
        )
    knots = np.concatenate([start[None], keyframes])
    position = np.clip(np.asarray(elapsed, dtype=np.float64) * rate_hz, 0.0, len(keyframes))
    before = np.minimum(position.astype(np.int64), max(len(keyframes) - 1, 0))
    share = (position - before)[:, None]
    after = np.minimum(before + 1, len(keyframes))
    points: Array = knots[before] * (1.0 - share) + knots[after] * share
    return points


# A lockstep clock sums its steps, and the sum is rounded: half a microsecond is nothing.
SAME_S = 5e-7


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


class ChunkJoiner(ABC):
    """Chunks in, targets out. All calls come from the thread that sends."""

    streamed: ClassVar[bool] = True
    """Whether it is asked at every tick; otherwise a chunk's commands are played in one piece."""
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
        """What the policy has to go on from; None for nothing."""
        return None


class StreamedJoiner(ChunkJoiner):
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
        return self._observed is None or now - self._observed >= self.every_s - SAME_S
