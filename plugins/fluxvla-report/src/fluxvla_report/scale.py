"""Axes of charts: which range, where the ticks are, how a number is written. Pure functions."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Axis:
    """A range of values shown over ``length`` pixels, linear or by decades.

    Args:
        low, high: the values at the two ends, ``low < high``; both positive when ``log``.
        ticks: the values that get a label, all within the range.
        log: by decades.
    """

    low: float
    high: float
    ticks: tuple[float, ...]
    log: bool = False

    def place(self, value: float) -> float:
        """0 at ``low``, 1 at ``high``; values outside are held at the ends."""
        if self.log:
            value = max(value, self.low)
            share = math.log(value / self.low) / math.log(self.high / self.low)
        else:
            share = (value - self.low) / (self.high - self.low)
        return min(1.0, max(0.0, share))


def axis(
    values: Iterable[float],
    *,
    log: bool = False,
    count: int = 5,
    tight: bool = False,
    least: float = 0.0,
) -> Axis:
    """An axis that holds all finite values, with about ``count`` round ticks.

    A log axis needs positive values; without any (or none that are finite) the axis is linear
    from 0 to 1. A ``tight`` one ends at the values, not at the ticks around them. A linear one
    shows at least a range of ``least``, so that a flat line does not look like a mountain range.
    """
    finite = [v for v in values if math.isfinite(v) and (v > 0 or not log)]
    if not finite:
        return Axis(0.0, 1.0, (0.0, 0.5, 1.0))
    low, high = min(finite), max(finite)
    if log:
        return _log_axis(low, high)
    if high - low < least:
        middle = (low + high) / 2
        low, high = middle - least / 2, middle + least / 2
    if low == high:
        low, high = (low - abs(low) * 0.1, high + abs(high) * 0.1) if low else (-1.0, 1.0)
    step = round_step((high - low) / max(1, count - 1))
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    ticks = tuple(step * n for n in range(first, last + 1))
    if tight:
        slack = 1e-9 * step
        return Axis(low, high, tuple(t for t in ticks if low - slack <= t <= high + slack))
    return Axis(ticks[0], ticks[-1], ticks)


def round_step(rough: float) -> float:
    """The smallest of 1, 2, 5 times a power of ten that is at least ``rough`` (> 0)."""
    power = 10.0 ** math.floor(math.log10(rough))
    for factor in (1.0, 2.0, 5.0):
        if factor * power >= rough * (1 - 1e-9):
            return factor * power
    return 10.0 * power


def _log_axis(low: float, high: float) -> Axis:
    if low == high:
        low, high = low / 2, high * 2
    decades = math.log10(high / low)
    factors = (1,) if decades > 3 else (1, 2, 5)
    first, last = math.floor(math.log10(low)) - 1, math.ceil(math.log10(high)) + 1
    grid = sorted(f * 10.0**p for p in range(first, last + 1) for f in factors)
    bottom = max((g for g in grid if g <= low * (1 + 1e-9)), default=low)
    top = min((g for g in grid if g >= high * (1 - 1e-9)), default=high)
    return Axis(bottom, top, tuple(g for g in grid if bottom <= g <= top), log=True)


def short(value: float) -> str:
    """A number for a tick or a table: at most four significant digits, ``12k``, ``3e-04``."""
    if not math.isfinite(value):
        return str(value)
    size = abs(value)
    if size and (size < 1e-3 or size >= 1e9):
        return f"{value:.3g}"
    for limit, unit in ((1e6, "M"), (1e3, "k")):
        if size >= limit * 10 or (size >= limit and value % 100 == 0):
            return f"{value / limit:.4g}{unit}"
    return f"{value:.4g}"


def duration(seconds: float) -> str:
    """``0.8 s``, ``42 s``, ``3 min 05 s``, ``2 h 10 min``."""
    if seconds < 10:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
