"""Statistics of states, actions and images, and normalisation by them.

Statistics are exact, in bounded memory. Mean and variance are kept as (count, mean, sum of squared
deviations) in float64 and joined by Chan's formula, so many small chunks give what one big one
gives. Quantiles of columns are true quantiles, taken of one dimension at a time; pixels have 256
values, so their histogram loses nothing.
Source: Chan, Golub, LeVeque, "Updating formulae and a pairwise algorithm for computing sample
variances", Stanford STAN-CS-79-773, 1979.

Normalisation is one formula for both directions: a value ``x`` becomes ``(x - offset) / scale``.
``relative`` in a statistics entry marks dimensions that are counted from the present state; they
are shifted by it before and after.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import CheckpointError, ConfigError, nearest

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
LEVELS = 256
CHUNK = 65536
_RANGES = {"quantile": ("q01", "q99"), "min_max": ("min", "max")}
NORM_TYPES = ("mean_std", *_RANGES, "none")
EPS = 1e-6
LARGEST_RANGE = 200.0
"""A dimension's range after scaling is ordinarily smaller: 2 by ``min_max``, some 20 by a
``quantile`` or standard deviation if it moves now and then."""
SMALLEST_SCALE = 1e-4
"""If a state is divided by less, an error of 0.01 in a reading becomes more than 100."""

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
        ValueError: there are no rows.
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
    """Statistics of several ``(n, D)`` arrays as if they were one; see ``column_statistics``.

    Args:
        parts: yields all arrays, restricted to some dimensions; one is in memory at a time.
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


def image_histogram(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.int64]:
    """Histogram of the 256 values, ``(3, 256)``, of an ``(H, W, 3)`` uint8 image."""
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


def _histogram_quantile(histogram: npt.NDArray[np.int64], level: float) -> float:
    """The quantile of the counted values, by linear interpolation as ``np.quantile`` does it."""
    cumulative = np.cumsum(histogram)
    place = level * (int(cumulative[-1]) - 1)
    low = int(np.floor(place))
    below, above = np.searchsorted(cumulative, [low, low + (place > low)], side="right")
    return float(below + (above - below) * (place - low))


@dataclass(frozen=True)
class Affine:
    """Offset and scale, each ``(D,)`` or ``(T, D)``; ``relative`` is ``(D,)`` of 0 and 1."""

    offset: Floats
    scale: Floats
    relative: Floats | None = None

    @property
    def dim(self) -> int:
        return int(self.offset.shape[-1])

    def forward(self, values: npt.ArrayLike, state: npt.ArrayLike | None = None) -> Floats:
        """Physical ``(..., D)`` -> normalised ``(..., D)``, in float64."""
        return (np.asarray(values, np.float64) - self._base(state) - self.offset) / self.scale

    def inverse(self, values: npt.ArrayLike, state: npt.ArrayLike | None = None) -> Floats:
        """Normalised ``(..., D)`` -> physical ``(..., D)``, in float64."""
        return np.asarray(values, np.float64) * self.scale + self.offset + self._base(state)

    def _base(self, state: npt.ArrayLike | None) -> Floats | float:
        if self.relative is None:
            return 0.0
        if state is None:
            raise ConfigError(
                "these actions are counted from the present state, and no state was given",
                next="pass the state in physical units as data['states']",
            )
        base: Floats = np.asarray(state, np.float64).reshape(-1)[: self.dim] * self.relative
        return base


def check_norm_type(norm_type: str, who: str) -> None:
    """Check a ``norm_type``.

    Raises:
        ConfigError: it is unknown; lists the known ones and suggests the nearest.
    """
    if norm_type in NORM_TYPES:
        return
    near = nearest(str(norm_type), NORM_TYPES)
    hint = f"; did you mean {near!r}?" if near else ""
    raise ConfigError(
        f"{who}: norm_type {norm_type!r} is not one of {', '.join(NORM_TYPES)}{hint}",
        cause="state_key and action_key select the statistics, norm_type the formula",
    )


def make_affine(
    stats: Mapping[str, Any],
    norm_type: str,
    who: str,
    std_floor: float = 0.0,
    norm_mask: Sequence[bool] | None = None,
    epsilon: float = EPS,
    epsilon_if_zero: bool = False,
) -> Affine:
    """Compute offset and scale from one statistics entry.

    Args:
        stats: ``mean``, ``std``, ``min``, ``max``, ``q01``, ``q99``: ``(D,)`` or ``(T, D)``;
            optionally ``relative`` ``(D,)``.
        norm_type: ``mean_std``: (x - mean) / (std + epsilon); ``quantile`` and ``min_max``:
            2 (x - low) / (high - low + epsilon) - 1; ``none``: x.
        std_floor: no dimension is divided by less than this, in the data's units: a joint that
            hardly moved in the demonstrations otherwise turns noise into huge values.
        norm_mask: ``(D,)``; False leaves a dimension as it is.
        epsilon: 1e-6 in openpi, 1e-8 in LeRobot.
        epsilon_if_zero: ranges of ``quantile`` and ``min_max`` get it only where they are 0.

    Raises:
        ConfigError: a statistic is missing, or the mask has another length.
    """
    mean = _entry(stats, "mean", who)
    used = ("std",) if norm_type == "mean_std" else _RANGES.get(norm_type, ())
    for name in used:
        shape = _entry(stats, name, who).shape
        if shape != mean.shape:
            raise ConfigError(
                f"{who}: {name!r} of the statistics has shape {shape}, 'mean' {mean.shape}"
            )
    if norm_type == "none":
        offset, scale = np.zeros_like(mean), np.ones_like(mean)
    elif norm_type == "mean_std":
        offset, scale = mean, np.maximum(_entry(stats, "std", who), std_floor) + epsilon
    else:
        low, high = (_entry(stats, name, who) for name in _RANGES[norm_type])
        span = high - low
        half = (np.where(span == 0, epsilon, span) if epsilon_if_zero else span + epsilon) / 2
        scale = np.maximum(half, std_floor)
        # ``low`` maps to -1 unless the floor widened the range; then its middle maps to 0.
        offset = np.where(scale > half, (low + high) / 2, low + scale)
    if norm_mask is not None:
        mask = np.asarray(norm_mask, bool)
        if mask.shape != offset.shape[-1:]:
            raise ConfigError(
                f"{who}: action_norm_mask has {mask.size} entries, "
                f"the statistics have {offset.shape[-1]}"
            )
        offset, scale = np.where(mask, offset, 0.0), np.where(mask, scale, 1.0)
    if stats.get("relative") is None:
        return Affine(offset, scale)
    relative = _numbers(stats["relative"], "relative", who)
    if relative.shape != offset.shape[-1:]:
        raise ConfigError(
            f"{who}: 'relative' of the statistics has shape {relative.shape}, "
            f"there are {offset.shape[-1]} dimensions"
        )
    return Affine(offset, scale, relative)


@dataclass(frozen=True)
class IdleDimension:
    """A dimension that hardly moves: ``spread`` is its max - min, ``scale`` what it is divided by.

    ``blown_up``: its small moves in the data become huge, not only a robot's readings.
    ``rare``: it moves in under 2 % of the frames, so that its q01 and q99 are equal.
    """

    name: str
    spread: float
    scale: float
    blown_up: bool
    rare: bool

    def __str__(self) -> str:
        return f"{self.name} (range {self.spread:.2g}, divided by {self.scale:.2g})"


def find_idle_dimensions(
    what: str,
    stats: Mapping[str, Any],
    scale: Floats,
    names: Sequence[str],
    mask: Sequence[bool] | None = None,
) -> Iterator[IdleDimension]:
    """Dimensions that hardly move, by one statistics entry; of several steps the worst one counts.

    Args:
        what: put before the names.
        scale: the divisors, as wide as the statistics.
        names: of the dimensions; their numbers are used where there are none.
        mask: ``(D,)``; False where nothing is divided.
    """
    if not {"min", "max", "q01", "q99"} <= set(stats):
        return
    low, high, q01, q99 = (np.atleast_2d(stats[k]) for k in ("min", "max", "q01", "q99"))
    spread, scale = high - low, np.atleast_2d(scale)
    rare = (q01 == q99) & (spread > 0)
    for d in range(spread.shape[1]):
        reach = spread[:, d] / scale[:, d]
        blown_up = bool(reach.max() > LARGEST_RANGE)
        step = int(reach.argmax() if blown_up else scale[:, d].argmin())
        used = mask is None or mask[d]
        if used and (blown_up or scale[step, d] < SMALLEST_SCALE):
            name = f"{what} {names[d] if names else d}"
            yield IdleDimension(
                name, spread[step, d], scale[step, d], blown_up, bool(rare[step, d])
            )


def _entry(stats: Mapping[str, Any], name: str, who: str) -> Floats:
    if name not in stats:
        raise ConfigError(
            f"{who}: the statistics have no {name!r}; they have {', '.join(sorted(stats))}"
        )
    return _numbers(stats[name], name, who)


def _numbers(value: Any, name: str, who: str) -> Floats:
    """``(D,)`` or ``(T, D)`` finite numbers, as the statistics of a file may not be.

    Raises:
        ConfigError: it is anything else.
    """
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different lengths
        array = np.asarray(None)
    plain = np.issubdtype(array.dtype, np.number) and not np.iscomplexobj(array)
    if not plain or array.ndim not in (1, 2) or not array.size or not np.isfinite(array).all():
        raise ConfigError(
            f"{who}: {name!r} of the statistics is not a list of finite numbers, one a dimension, "
            "nor of such lists, one a step"
        )
    return array.astype(np.float64)


def check_statistics(statistics: Mapping[str, Mapping[str, Any]], where: str) -> None:
    """Refuse statistics that are not finite numbers, as many in each row of an entry.

    Args:
        statistics: ``{"private": {"proprio": {"mean": [...], ...}, "action": {...}}}``.
        where: the checkpoint.

    Raises:
        CheckpointError: names the entry, the statistic, and what is wrong with it.
    """
    for entries in statistics.values():
        for key, entry in entries.items():
            rows = entry.items() if isinstance(entry, Mapping) else ()
            _check_rows(key, {n: r for n, r in rows if isinstance(r, list | tuple)}, where)


def _check_rows(key: str, rows: Mapping[str, Any], where: str) -> None:
    widths: dict[str, int] = {}
    for name, row in rows.items():
        try:
            numbers = np.asarray(row, np.float64)
        except (TypeError, ValueError):
            numbers = np.empty(0)
        wrong = numbers[~np.isfinite(numbers)]
        if not numbers.size or wrong.size:
            found = f"has {wrong[0]}" if wrong.size else f"is {str(row)[:60]}"
            raise CheckpointError(
                f"the statistics' {name!r} of {key!r} {found}; finite numbers are expected",
                where=where,
                cause="they were computed from data with gaps, or the file is damaged",
                next="take the statistics of the training's data, or compute them again",
            )
        widths[name] = int(numbers.shape[-1])
    first = next(iter(widths), "")
    other = next((name for name in widths if widths[name] != widths[first]), None)
    if other is not None:
        raise CheckpointError(
            f"the statistics of {key!r} have {widths[first]} dimensions in {first!r}, "
            f"{widths[other]} in {other!r}",
            where=where,
            cause="the file was changed, or joined of two robots'",
        )
