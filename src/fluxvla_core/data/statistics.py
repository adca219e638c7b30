"""Exact statistics for normalisation: of columns, action windows and images, in bounded memory.

Mean and variance are kept as (count, mean, sum of squared deviations) in float64 and joined by
Chan's formula, so many small chunks give what one big one gives. Quantiles of columns are true
quantiles, taken of one dimension at a time; pixels have 256 values, so their histogram loses
nothing.
Source: Chan, Golub, LeVeque, "Updating formulae and a pairwise algorithm for computing sample
variances", Stanford STAN-CS-79-773, 1979.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.data.columns import LoadedDataset

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
LEVELS = 256
CHUNK = 65536
Floats = npt.NDArray[np.float64]
Stats = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class Moments:
    """Count, mean, sum of squared deviations, min and max of the rows seen; each ``(D,)``."""

    count: int
    mean: Floats
    m2: Floats
    min: Floats
    max: Floats

    @classmethod
    def of(cls, rows: npt.NDArray[Any]) -> Moments:
        """Moments of ``(N, D)`` rows, N at least 1."""
        wide = rows.astype(np.float64)
        mean = wide.mean(axis=0)
        m2 = np.square(wide - mean).sum(axis=0)
        return cls(len(wide), mean, m2, wide.min(axis=0), wide.max(axis=0))

    def merge(self, other: Moments) -> Moments:
        """Moments of both together."""
        count = self.count + other.count
        delta = other.mean - self.mean
        return Moments(
            count,
            self.mean + delta * (other.count / count),
            self.m2 + other.m2 + np.square(delta) * (self.count * other.count / count),
            np.minimum(self.min, other.min),
            np.maximum(self.max, other.max),
        )

    @property
    def std(self) -> Floats:
        """Population standard deviation, ``(D,)``."""
        return np.sqrt(self.m2 / self.count)


def moments(chunks: Iterable[npt.NDArray[Any]]) -> Moments:
    """Moments of all rows of all non-empty ``(n, D)`` chunks.

    Raises:
        ValueError: there is not one row.
    """
    total: Moments | None = None
    for chunk in chunks:
        if len(chunk):
            part = Moments.of(chunk)
            total = part if total is None else total.merge(part)
    if total is None:
        raise ValueError("statistics of no rows")
    return total


def column_statistics(rows: npt.NDArray[Any], chunk: int = CHUNK) -> Stats:
    """Statistics of ``(N, D)`` rows: min, max, mean, std, the quantiles (each ``(D,)``), count.

    ``count`` is ``(1,)`` int64. The chunk bounds memory, not precision.
    """
    return joined_statistics(lambda dims: [rows[:, dims]], chunk)


def joined_statistics(
    parts: Callable[[slice], Iterable[npt.NDArray[Any]]], chunk: int = CHUNK
) -> Stats:
    """Those of several ``(n, D)`` arrays as if they were one, of which one is held at a time.

    Args:
        parts: gives all arrays, one after the other, with the dimensions that it is asked for.
    """
    total = moments(_cut(parts(slice(None)), chunk))
    # True quantiles need all values of a dimension at once, but not those of all dimensions.
    levels = [
        np.quantile(_column(parts(slice(d, d + 1))), list(QUANTILES.values()), overwrite_input=True)
        for d in range(len(total.mean))
    ]
    return {
        "min": total.min,
        "max": total.max,
        "mean": total.mean,
        "std": total.std,
        "count": np.array([total.count], dtype=np.int64),
        **dict(zip(QUANTILES, np.stack(levels, axis=1), strict=True)),
    }


def action_statistics(
    datasets: Sequence[LoadedDataset],
    size: int,
    first_action: int,
    relative: npt.NDArray[np.bool_] | None,
    per_step: bool,
) -> dict[str, Any]:
    """Statistics of the actions that samples show, as JSON values.

    Args:
        size, first_action: of the window.
        relative: ``(D,)``; where True, actions are counted from the state at the window's frame.
        per_step: give ``(size, D)`` statistics, one row for each step of the window.

    Plain actions are counted once a frame of the chosen episodes; relative or per-step ones once
    for each window that they occur in.
    """
    if relative is None and not per_step:
        rows = np.concatenate([r.actions[r.chosen] for r in datasets])
        return as_lists(column_statistics(rows))
    if per_step:
        # The last steps of a window longer than every episode occur nowhere.
        each: list[Stats] = []
        for j in range(size):
            rows = _step(datasets, first_action + j, relative, slice(None))
            each.append(column_statistics(rows) if len(rows) else each[0])
        stats = {name: np.stack([s[name] for s in each]) for name in each[0]}
    else:
        stats = joined_statistics(
            lambda dims: (_step(datasets, first_action + j, relative, dims) for j in range(size))
        )
    found = as_lists(stats)
    if relative is not None:
        found["relative"] = relative.astype(int).tolist()
    return found


def image_histogram(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.int64]:
    """How often each of 256 values occurs, ``(3, 256)``, in an ``(H, W, 3)`` uint8 image."""
    planes = [np.ascontiguousarray(image[..., c]).ravel() for c in range(3)]
    return np.stack([np.bincount(plane, minlength=LEVELS) for plane in planes]).astype(np.int64)


def histogram_statistics(histogram: npt.NDArray[np.int64], frames: int) -> Stats:
    """Statistics of the pixels counted in ``(3, 256)``, scaled to 0..1, each ``(3, 1, 1)``.

    ``count`` is the number of frames, ``(1,)``, as LeRobot counts images.
    """
    values = np.arange(LEVELS, dtype=np.float64)
    pixels = histogram.sum(axis=1)
    mean = histogram @ values / pixels
    variance = np.array([h @ np.square(values - m) for h, m in zip(histogram, mean, strict=True)])
    seen = [np.flatnonzero(channel) for channel in histogram]
    stats: dict[str, npt.NDArray[Any]] = {
        "min": np.array([s[0] for s in seen], np.float64),
        "max": np.array([s[-1] for s in seen], np.float64),
        "mean": mean,
        "std": np.sqrt(variance / pixels),
    }
    for name, level in QUANTILES.items():
        stats[name] = np.array([_histogram_quantile(h, level) for h in histogram])
    scaled = {name: (value / 255.0).reshape(3, 1, 1) for name, value in stats.items()}
    return {**scaled, "count": np.array([frames], dtype=np.int64)}


def as_lists(stats: Mapping[str, npt.NDArray[Any]]) -> dict[str, Any]:
    """Plain JSON values."""
    return {name: value.tolist() for name, value in stats.items()}


def _cut(parts: Iterable[npt.NDArray[Any]], size: int) -> Iterator[npt.NDArray[Any]]:
    """All rows in chunks of ``size``, wherever one part ends and the next begins."""
    held: list[npt.NDArray[Any]] = []
    for part in parts:
        while len(part):
            held.append(part[: size - sum(map(len, held))])
            part = part[len(held[-1]) :]
            if sum(map(len, held)) == size:
                yield np.concatenate(held)
                held = []
    if held:
        yield np.concatenate(held)


def _column(parts: Iterable[npt.NDArray[Any]]) -> Floats:
    return np.concatenate([part[:, 0].astype(np.float64) for part in parts])


def _step(
    datasets: Sequence[LoadedDataset],
    ahead: int,
    relative: npt.NDArray[np.bool_] | None,
    dims: slice,
) -> npt.NDArray[np.float32]:
    """Actions ``ahead`` rows after each usable one, where they are within the episode."""
    parts = []
    for one in datasets:
        rows = one.rows[one.rows + ahead < one.end[one.rows]]
        actions = one.actions[:, dims][rows + ahead]
        if relative is not None:
            actions = actions - one.states[:, : len(relative)][:, dims][rows] * relative[dims]
        parts.append(actions)
    return np.concatenate(parts)


def _histogram_quantile(histogram: npt.NDArray[np.int64], level: float) -> float:
    """The quantile of the counted values, by linear interpolation as ``np.quantile`` does it."""
    cumulative = np.cumsum(histogram)
    place = level * (int(cumulative[-1]) - 1)
    low = int(np.floor(place))
    below, above = np.searchsorted(cumulative, [low, low + (place > low)], side="right")
    return float(below + (above - below) * (place - low))
