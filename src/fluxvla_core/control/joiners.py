"""Chunk joiners: synchronous, latest only, temporal ensemble, cross-fade, real-time chunking.

A ``ChunkJoiner`` is given chunks as they arrive and asked, for each command, where the arm should
be. Everything in it goes by time stamps, never by counts: a chunk is placed at the time of the
observation that it answers, so that a policy which is slow, or slow now and then, costs nothing but
the beginning of its chunk. ``make_joiner`` makes the one that a config's ``chunk_joining`` names.
"""

from __future__ import annotations

import bisect
import inspect
import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.policy import Continuation
from fluxvla_core.control.chunks import Chunk, sample
from fluxvla_core.errors import ConfigError, nearest

Array = npt.NDArray[np.float64]
SCHEDULES = ("exp", "linear", "ones", "zeros")
# A lockstep clock sums its steps, and the sum is rounded: half a microsecond is nothing.
SAME_S = 5e-7


class ChunkJoiner(ABC):
    """Chunks in, targets out. All calls come from the thread that sends."""

    streamed: ClassVar[bool] = True
    """Whether it is asked at every tick; otherwise a chunk's commands are played in one piece."""
    continues: ClassVar[bool] = False
    """Whether the policy is asked to continue the chunk that is being played."""

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

    def previous_chunk(self) -> PreviousChunk | None:
        """The chunk that the policy has to continue (real-time chunking); None for none."""
        return None


class StreamedJoiner(ChunkJoiner):
    """Base of the joiners that ask for the next chunk while one is being played.

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


class Synchronous(ChunkJoiner):
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
        return self._chunk is None or now - self._start >= self._chunk.seconds - SAME_S


class LatestOnly(StreamedJoiner):
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


class TemporalEnsemble(StreamedJoiner):
    """The weighted mean of all chunks that reach a moment.

    Zhao et al. 2023 (ACT, arXiv 2304.13705, section IV-B) ask the policy at every step and give
    the ``i``-th oldest of the predictions for a moment the weight ``exp(-m i)``: the oldest counts
    most. Here ``i`` is the time between the two observations in action periods, which is the same
    number when the policy is asked once an action period, and stays right when it is asked less
    regularly.

    Args:
        every_s: see ``StreamedJoiner``.
        coefficient: ``m``; larger ones listen less to newer chunks, negative ones more.
    """

    def __init__(self, every_s: float = 0.0, coefficient: float = 0.01) -> None:
        super().__init__(every_s)
        if not math.isfinite(coefficient):
            raise ConfigError(f"coefficient must be a number, got {coefficient!r}")
        self.coefficient = coefficient
        self._chunks: list[Chunk] = []

    def reset(self) -> None:
        super().reset()
        self._chunks = []

    def add(self, chunk: Chunk, now: float) -> None:
        super().add(chunk, now)
        self._chunks = [c for c in self._chunks if c.reaches(now - c.observed)]
        bisect.insort(self._chunks, chunk, key=lambda c: c.observed)

    def target(self, at: float) -> Array | None:
        known = [c for c in self._chunks if c.reaches(at - c.observed)]
        if not known:
            return None
        # Counted from the newest: the same shares, and no overflow for a coefficient below 0.
        reference = known[-1] if self.coefficient < 0 else known[0]
        ages = np.array([(c.observed - reference.observed) * c.rate_hz for c in known])
        weights = np.exp(-self.coefficient * ages)
        points = np.array([c.at(at - c.observed) for c in known])
        mean: Array = weights @ points / weights.sum()
        return mean


class Overlap(StreamedJoiner):
    """A cross-fade from the motion under way to each new chunk, beginning when it arrives.

    The share of the new chunk is ``3 s^2 - 2 s^3`` with ``s`` from 0 to 1 in ``fade_s``, so that
    neither position nor speed jumps at the join. A chunk that arrives during a fade is faded to
    from wherever that fade is.

    Args:
        every_s: see ``StreamedJoiner``.
        fade_s: seconds that a cross-fade takes.
    """

    def __init__(self, every_s: float = 0.0, fade_s: float = 0.2) -> None:
        super().__init__(every_s)
        if not (math.isfinite(fade_s) and fade_s > 0):
            raise ConfigError(f"fade_s must be a positive number of seconds, got {fade_s!r}")
        self.fade_s = fade_s
        self._fades: list[tuple[Chunk, float]] = []

    def reset(self) -> None:
        super().reset()
        self._fades = []

    def add(self, chunk: Chunk, now: float) -> None:
        super().add(chunk, now)
        if self._fades and chunk.observed < self._fades[-1][0].observed:
            return
        # What is hidden behind a fade that is over has no share any more.
        over = [i for i, (_, began) in enumerate(self._fades) if now - began >= self.fade_s]
        self._fades = [*self._fades[over[-1] if over else 0 :], (chunk, now)]

    def target(self, at: float) -> Array | None:
        if not self._fades:
            return None
        newest = self._fades[-1][0]
        if not newest.reaches(at - newest.observed):
            return None
        first = self._fades[0][0]
        point = first.at(at - first.observed)
        for chunk, began in self._fades[1:]:
            share = min(max((at - began) / self.fade_s, 0.0), 1.0)
            share = share * share * (3.0 - 2.0 * share)
            point = point + share * (chunk.at(at - chunk.observed) - point)
        return point


def soft_mask(horizon: int, frozen: int, known: int, schedule: str = "exp") -> Array:
    """Weights ``W`` of how closely each action of a new chunk has to match the old one.

    With ``d`` frozen actions and ``k`` that the old chunk reaches (the paper's ``H - s``),
    ``c_i = (k - i) / (k - d + 1)`` (the paper's equation 5):

        W_i = 1                                 for i < d
        W_i = c_i (exp(c_i) - 1) / (e - 1)      for d <= i < k     (``linear``: c_i)
        W_i = 0                                 for i >= k

    Args:
        horizon: actions of the new chunk.
        frozen: ``d``, at most ``known``.
        known: ``k``, at most ``horizon``.
        schedule: ``exp``, ``linear``, ``ones`` (all that is known) or ``zeros`` (only the frozen).

    Returns:
        ``(horizon,)``.
    """
    index = np.arange(horizon)
    share = np.clip((known - index) / (known - frozen + 1), 0.0, 1.0)
    middle = {
        "exp": share * np.expm1(share) / np.expm1(1.0),
        "linear": share,
        "ones": np.ones(horizon),
        "zeros": np.zeros(horizon),
    }[schedule]
    weights: Array = np.where(index < frozen, 1.0, np.where(index < known, middle, 0.0))
    return weights


@dataclass(frozen=True)
class PreviousChunk:
    """The chunk that is being executed while the next is computed, as real-time chunking needs it.

    Args:
        chunk: that is being executed.
        latency_s: how late after its observation the next chunk is expected.
        schedule: see ``soft_mask``.
        max_guidance_weight: see ``RealTime``.
    """

    chunk: Chunk
    latency_s: float
    schedule: str
    max_guidance_weight: float

    def continuation(self, observed: float, horizon: int) -> Continuation | None:
        """The prefix that the next chunk has to continue: what is left of this one.

        Args:
            observed: time of the observation that the next chunk answers.
            horizon: how many actions the next chunk has.

        Returns:
            This chunk's actions at the times of the next one's, and how much each of them counts;
            None if this chunk ends before the next one's first action.
        """
        chunk = self.chunk
        elapsed = observed - chunk.observed + (np.arange(horizon) + 1.0) / chunk.rate_hz
        known = sum(chunk.reaches(float(seconds)) for seconds in elapsed)
        if known == 0:
            return None
        # A command between two actions is made of both, so both must be the old chunk's.
        frozen = min(max(math.ceil(self.latency_s * chunk.rate_hz - 1e-6), 0), known)
        return Continuation(
            actions=sample(chunk.anchor, chunk.actions, chunk.rate_hz, elapsed),
            weights=soft_mask(horizon, frozen, known, self.schedule),
            frozen=frozen,
            max_guidance_weight=self.max_guidance_weight,
        )


class RealTime(StreamedJoiner):
    """Real-time chunking: the policy makes the next chunk continue the one that is being played.

    Black, Galliker and Levine 2025, "Real-Time Execution of Action Chunking Flow Policies" (arXiv
    2506.07339). While a policy thinks, the arm continues along the old chunk. The first ``d``
    actions of the new one are over when it arrives, so they are fixed to what will have been
    executed; later ones are drawn to the old chunk the less the later they are; those that the old
    chunk does not reach are free. ``soft_mask`` has the weights, and the policy does the rest
    (``continue_action``).

    There ``d`` and the rest of the old chunk are counted in steps. Here both come from time: the
    old chunk is read off at the new one's own times, and ``d`` is the longest of the last few
    latencies that were measured, from the observation to the arrival of its chunk in the loop that
    sends. A latency that is longer than any before costs a step at the join, which the limiter
    takes up; it never shifts the motion, because a chunk is played on the time of its observation.
    The old chunk is played up to the first action of the new one that is not over, where both are
    the same: so the corners of the old one that lie between two times of the new one are not cut.

    Args:
        every_s: see ``StreamedJoiner``; the paper's smallest execution horizon.
        max_guidance_weight: bound of the pull towards the old chunk; the paper's beta.
        schedule: see ``soft_mask``.
        window: how many measured latencies are remembered; the longest of them is expected.
    """

    continues: ClassVar[bool] = True

    def __init__(
        self,
        every_s: float = 0.0,
        max_guidance_weight: float = 5.0,
        schedule: str = "exp",
        window: int = 10,
    ) -> None:
        super().__init__(every_s)
        if schedule not in SCHEDULES:
            near = nearest(str(schedule), SCHEDULES)
            hint = f"; did you mean {near!r}?" if near else ""
            raise ConfigError(
                f"schedule {schedule!r} is unknown; choose one of {', '.join(SCHEDULES)}{hint}"
            )
        if not (math.isfinite(max_guidance_weight) and max_guidance_weight > 0):
            raise ConfigError(f"max_guidance_weight must be positive, got {max_guidance_weight!r}")
        if window < 1:
            raise ConfigError(f"window must be at least 1, got {window!r}")
        self.max_guidance_weight = max_guidance_weight
        self.schedule = schedule
        self._latencies: deque[float] = deque(maxlen=window)
        self._chunks: list[tuple[Chunk, float]] = []  # and the time from which each is played

    def reset(self) -> None:
        super().reset()
        self._latencies.clear()
        self._chunks = []

    def add(self, chunk: Chunk, now: float) -> None:
        super().add(chunk, now)
        latency = now - chunk.observed
        self._latencies.append(latency)
        if self._chunks and chunk.observed < self._chunks[-1][0].observed:
            return
        over = math.ceil(latency * chunk.rate_hz - 1e-6)
        played = [i for i, (_, begins) in enumerate(self._chunks) if begins <= now]
        begins = chunk.observed + over / chunk.rate_hz
        self._chunks = [*self._chunks[played[-1] if played else 0 :], (chunk, begins)]

    def target(self, at: float) -> Array | None:
        begun = [chunk for chunk, begins in self._chunks if begins <= at]
        newest = [chunk for chunk, _ in self._chunks[-1:]]
        # The newest before its time, too, where the one before it has ended.
        for chunk in (*begun[-1:], *newest):
            if chunk.reaches(at - chunk.observed):
                return chunk.at(at - chunk.observed)
        return None

    def previous_chunk(self) -> PreviousChunk | None:
        if not self._chunks:
            return None
        newest = self._chunks[-1][0]
        return PreviousChunk(newest, max(self._latencies), self.schedule, self.max_guidance_weight)


STREAMED: Mapping[str, type[StreamedJoiner]] = {
    "latest_only": LatestOnly,
    "temporal_ensemble": TemporalEnsemble,
    "overlap": Overlap,
    "rtc": RealTime,
}
METHODS = ("synchronous", *STREAMED)


def make_joiner(value: str | Mapping[str, Any] | None, every_s: float = 0.0) -> ChunkJoiner:
    """The joiner that a config asks for.

    Args:
        value: a name of ``METHODS``, or a table with ``method = '<name>'`` and the parameters of
            its class; None means ``synchronous``.
        every_s: how far apart observations should be, for those that ask while they play.

    Raises:
        ConfigError: an unknown method or parameter (with the nearest one), or a bad value.
    """
    options = dict(value) if isinstance(value, Mapping) else {"method": value or "synchronous"}
    method = options.pop("method", None)
    if method not in METHODS:
        raise ConfigError(f"method {method!r}{_hint(method, METHODS)}")
    kind: Any = STREAMED.get(str(method), Synchronous)
    taken = [name for name in inspect.signature(kind).parameters if name != "every_s"]
    for name in options:
        if name not in taken:
            raise ConfigError(f"{method} takes no {name!r}{_hint(name, taken)}")
    if kind is Synchronous:
        return Synchronous()
    try:
        joiner: ChunkJoiner = kind(every_s=every_s, **options)
    except TypeError as error:
        raise ConfigError(f"{method}: {error}") from error
    except ConfigError as error:
        raise ConfigError(f"{method}: {error.what}") from error
    return joiner


def _hint(name: Any, known: tuple[str, ...] | list[str]) -> str:
    near = nearest(str(name), known)
    if near:
        return f"; did you mean {near!r}?"
    return f"; there are {', '.join(known)}" if known else "; it takes nothing"
