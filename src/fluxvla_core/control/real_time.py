"""Real-time chunking: the policy makes the next chunk go on from the one that is being played.

Black, Galliker and Levine 2025, "Real-Time Execution of Action Chunking Flow Policies" (arXiv
2506.07339). While a policy thinks, the arm goes on along the old chunk. The first ``d`` keyframes
of the new one are over when it arrives, so they are fixed to what will have been executed; later
ones are drawn to the old chunk the less the later they are; those that the old chunk does not reach
are free. ``soft_mask`` has the weights, and the policy does the rest (``continue_action``).

There ``d`` and the rest of the old chunk are counted in steps. Here both come from time: the old
chunk is read off at the new one's own times, and ``d`` is the longest of the last few latencies
that were measured, from the observation to the arrival of its chunk in the loop that sends. A
latency that is longer than any before costs a step at the join, which the limiter takes up; it
never shifts the motion, because a chunk is played on the time of its observation. The old chunk is
played up to the first keyframe of the new one that is not over, where both are the same: so the
corners of the old one that lie between two times of the new one are not cut.
"""

from __future__ import annotations

import difflib
import math
from collections import deque
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.continuation import Continuation
from fluxvla_core.control.joining import Ahead, Chunk, Streamed
from fluxvla_core.control.keyframes import sample
from fluxvla_core.errors import ConfigError

Array = npt.NDArray[np.float64]
SCHEDULES = ("exp", "linear", "ones", "zeros")


def soft_mask(horizon: int, frozen: int, known: int, schedule: str = "exp") -> Array:
    """How much each keyframe of a new chunk has to agree with the old one: ``W``.

    With ``d`` frozen keyframes and ``k`` that the old chunk reaches (the paper's ``H - s``),
    ``c_i = (k - i) / (k - d + 1)`` (the paper's equation 5):

        W_i = 1                                 for i < d
        W_i = c_i (exp(c_i) - 1) / (e - 1)      for d <= i < k     (``linear``: c_i)
        W_i = 0                                 for i >= k

    Args:
        horizon: keyframes of the new chunk.
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
class RestOfChunk(Ahead):
    """The chunk that is being played, and how late the next one is expected."""

    chunk: Chunk
    latency_s: float
    schedule: str
    max_guidance_weight: float

    def seen_at(self, observed: float, horizon: int) -> Continuation | None:
        chunk = self.chunk
        elapsed = observed - chunk.observed + (np.arange(horizon) + 1.0) / chunk.rate_hz
        known = sum(chunk.reaches(float(seconds)) for seconds in elapsed)
        if known == 0:
            return None
        # A command between two keyframes is made of both, so both must be the old chunk's.
        frozen = min(max(math.ceil(self.latency_s * chunk.rate_hz - 1e-6), 0), known)
        return Continuation(
            actions=sample(chunk.anchor, chunk.keyframes, chunk.rate_hz, elapsed),
            weights=soft_mask(horizon, frozen, known, self.schedule),
            frozen=frozen,
            max_guidance_weight=self.max_guidance_weight,
        )


class RealTime(Streamed):
    """Chunks on the time of their observation, each asked for as a continuation of the one before.

    Args:
        every_s: see ``Streamed``; the paper's smallest execution horizon.
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
            near = difflib.get_close_matches(str(schedule), SCHEDULES, 1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise ConfigError(f"schedule {schedule!r} is none of {', '.join(SCHEDULES)}{hint}")
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

    def ahead(self) -> Ahead | None:
        if not self._chunks:
            return None
        newest = self._chunks[-1][0]
        return RestOfChunk(newest, max(self._latencies), self.schedule, self.max_guidance_weight)
