"""Joiners that make one motion of several chunks: ACT's temporal ensemble, and a cross-fade."""

from __future__ import annotations

import bisect
import math

import numpy as np
import numpy.typing as npt

from fluxvla_core.control.joining import Chunk, Streamed
from fluxvla_core.errors import ConfigError

Array = npt.NDArray[np.float64]


class TemporalEnsemble(Streamed):
    """The weighted mean of every chunk that says something about a moment.

    Zhao et al. 2023 (ACT, arXiv 2304.13705, section IV-B) ask the policy at every step and give
    the ``i``-th oldest of the predictions for a moment the weight ``exp(-m i)``: the oldest counts
    most. Here ``i`` is the time between the two observations in keyframes, which is the same number
    when the policy is asked once a keyframe, and stays right when it is asked less regularly.

    Args:
        every_s: see ``Streamed``.
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


class Overlap(Streamed):
    """A cross-fade from the motion under way to each new chunk, beginning when it arrives.

    The share of the new chunk is ``3 s^2 - 2 s^3`` with ``s`` from 0 to 1 in ``fade_s``, so that
    neither position nor speed jumps at the join. A chunk that arrives during a fade is faded to
    from wherever that fade is.

    Args:
        every_s: see ``Streamed``.
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
