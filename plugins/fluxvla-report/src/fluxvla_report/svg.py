"""Charts and their axes as inline SVG, in the colours of the page: light and dark both work.

Classes the page's style sheet gives a colour to: ``s0`` … ``s5`` (series), ``grid``, ``axis``,
``tick``, ``label``, ``good``, ``bad``, ``band``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape

LEFT, RIGHT, TOP, BOTTOM = 48, 12, 10, 34
ROW_HEIGHT = 26
MOST_POINTS = 400


@dataclass(frozen=True)
class Series:
    """Points to draw.

    Args:
        name: for the legend; empty: not in it.
        xs, ys: equally many values; a point that is not finite interrupts the line.
        css: the colour's class.
        kind: ``line``, ``faint`` (a thin, pale line), ``dashed`` or ``dots``.
    """

    name: str
    xs: Sequence[float]
    ys: Sequence[float]
    css: str = "s0"
    kind: str = "line"


@dataclass(frozen=True)
class Interval:
    """One row of an interval chart: an estimate between two bounds, all in 0..1."""

    name: str
    note: str
    low: float
    value: float
    high: float
    css: str = "s0"


@dataclass(frozen=True)
class Row:
    """One row of a chart over a common scale.

    Args:
        label: its name; shown next to the drawing, or above it on a narrow page.
        body: SVG; x in percent of the width (``percent``), y from 0 to ``ROW_HEIGHT``.
        notes: figures at its end, a column each.
        about: shows under the pointer.
    """

    label: str
    body: str
    notes: Sequence[str] = ()
    about: str = ""


@dataclass(frozen=True)
class Shade:
    """A stretch of the x axis to shade, with a name that shows under the pointer."""

    name: str
    start: float
    end: float


@dataclass(frozen=True)
class Mark:
    """A place on the x axis (``vertical``) or on the y axis to draw a line at."""

    at: float
    name: str
    css: str = "bad"
    vertical: bool = True


def line_chart(
    series: Sequence[Series],
    *,
    x_label: str,
    title: str,
    log: bool = False,
    least: float = 0.0,
    width: int = 520,
    height: int = 210,
    shades: Sequence[Shade] = (),
    marks: Sequence[Mark] = (),
) -> str:
    """Lines and dots over common axes; the title is what a screen reader says.

    The y axis is by decades if ``log``, and shows at least a range of ``least``. Marks outside of
    the axes are left out.
    """
    x_axis = axis([x for s in series for x in s.xs], count=6, tight=True)
    y_axis = axis([y for s in series for y in s.ys], log=log, count=5, least=least)
    inner = _Inner(x_axis, y_axis, width, height)
    body = [_shade(inner, shade) for shade in shades]
    body.append(_frame(inner, x_label))
    body += [_mark(inner, mark) for mark in marks if not mark.vertical]
    body += [_draw(inner, s) for s in series]
    body += [_mark(inner, mark) for mark in marks if mark.vertical]
    return wrapped(width, height, title, "".join(body))


def interval_chart(rows: Sequence[Interval], *, title: str) -> str:
    """A dot with its interval for each row, on a common scale from 0 to 100 %."""
    middle = ROW_HEIGHT / 2
    drawn = [
        Row(
            row.name,
            f'<g class="{row.css}"><line class="band" x1="{percent(row.low)}" y1="{middle}" '
            f'x2="{percent(row.high)}" y2="{middle}"/>'
            f'<circle class="dot" cx="{percent(row.value)}" cy="{middle}" r="6"/></g>',
            (row.note,),
        )
        for row in rows
    ]
    scale = [(share, f"{share:.0%}") for share in (0.0, 0.25, 0.5, 0.75, 1.0)]
    return rows_chart(drawn, title=title, ticks=scale)


def rows_chart(rows: Sequence[Row], *, title: str, ticks: Sequence[tuple[float, str]] = ()) -> str:
    """Rows over a common scale, as wide as the page is: the style sheet places their parts.

    Args:
        rows: what is drawn.
        title: what a screen reader says.
        ticks: places in 0..1 with their labels; each row has a line there.
    """
    grid = "".join(
        f'<line class="grid" x1="{percent(at)}" y1="0" x2="{percent(at)}" y2="{ROW_HEIGHT}"/>'
        for at, _ in ticks
    )
    labels = "".join(
        f'<text class="tick" x="{percent(at)}" y="12" text-anchor="middle">{escape(text)}</text>'
        for at, text in ticks
    )
    drawn = [(row, grid + row.body) for row in rows]
    parts = [_row(row, body, ROW_HEIGHT if body else 0) for row, body in drawn]
    if ticks:
        parts.append(_row(Row("", "", ("",)), labels, 18))
    return f'<div class="rows" role="group" aria-label="{escape(title)}">{"".join(parts)}</div>'


def _row(row: Row, drawn: str, height: int) -> str:
    about = f' title="{escape(row.about)}"' if row.about else ""
    notes = "".join(f"<span>{escape(note)}</span>" for note in row.notes)
    return (
        f'<span class="label"{about}>{escape(row.label)}</span><span class="notes">{notes}</span>'
        f'<svg class="track" style="height:{height}px">{drawn}</svg>'
    )


def percent(share: float) -> str:
    """A place or a length in 0..1 of a chart's width, whatever that is."""
    return f"{100 * share:.2f}%"


def duration_bar(parts: Sequence[tuple[str, float]], *, title: str) -> str:
    """One bar that is divided among named durations (s), and a legend with the figures."""
    total = sum(seconds for _, seconds in parts) or 1.0
    bar, legend, x = [], [], 0.0
    for number, (name, seconds) in enumerate(parts):
        share, css = seconds / total, f"s{number % 6}"
        text = f"{escape(name)} · {duration(seconds)}"
        bar.append(
            f'<g class="{css}"><rect class="fill edge" x="{percent(x)}" y="0" '
            f'width="{percent(share)}" height="24"><title>{text}</title></rect></g>'
        )
        legend.append(f'<li><i class="box {css}"></i>{text}</li>')
        x += share
    return (
        f'<div role="group" aria-label="{escape(title)}">'
        f'<svg class="track" style="height:24px">{"".join(bar)}</svg>'
        f'<ul class="legend">{"".join(legend)}</ul></div>'
    )


def thinned(xs: Sequence[float], ys: Sequence[float], most: int = MOST_POINTS) -> list[int]:
    """Indices of at most about ``most`` points that keep every peak: two of each stretch."""
    count = len(xs)
    if count <= most:
        return list(range(count))
    chosen: set[int] = {0, count - 1}
    size = count / (most / 2)
    for stretch in range(int(most / 2)):
        indices = range(int(stretch * size), min(count, int((stretch + 1) * size)))
        finite = [i for i in indices if math.isfinite(ys[i])]
        if finite:
            chosen |= {min(finite, key=lambda i: ys[i]), max(finite, key=lambda i: ys[i])}
        elif indices:
            chosen.add(indices[0])  # keep the gap
    return sorted(chosen)


@dataclass(frozen=True)
class _Inner:
    x: Axis
    y: Axis
    width: int
    height: int

    def at(self, x: float, y: float) -> tuple[float, float]:
        return (
            LEFT + self.x.place(x) * (self.width - LEFT - RIGHT),
            self.height - BOTTOM - self.y.place(y) * (self.height - TOP - BOTTOM),
        )


def _frame(inner: _Inner, x_label: str) -> str:
    parts = []
    for tick in inner.y.ticks:
        _, y = inner.at(inner.x.low, tick)
        parts.append(
            f'<line class="grid" x1="{LEFT}" y1="{y:.1f}" x2="{inner.width - RIGHT}" '
            f'y2="{y:.1f}"/><text class="tick" x="{LEFT - 6}" y="{y + 4:.1f}" '
            f'text-anchor="end">{short(tick)}</text>'
        )
    bottom = inner.height - BOTTOM
    for tick in inner.x.ticks:
        x, _ = inner.at(tick, inner.y.low)
        parts.append(
            f'<text class="tick" x="{x:.1f}" y="{bottom + 15}" text-anchor="middle">'
            f"{short(tick)}</text>"
        )
    parts.append(
        f'<line class="axis" x1="{LEFT}" y1="{bottom}" x2="{inner.width - RIGHT}" y2="{bottom}"/>'
        f'<text class="tick" x="{inner.width - RIGHT}" y="{inner.height - 4}" '
        f'text-anchor="end">{escape(x_label)}</text>'
    )
    return "".join(parts)


def _shade(inner: _Inner, shade: Shade) -> str:
    (x1, _), (x2, _) = inner.at(shade.start, inner.y.low), inner.at(shade.end, inner.y.low)
    return (
        f'<rect class="shade" x="{x1:.1f}" y="{TOP}" width="{max(0.0, x2 - x1):.1f}" '
        f'height="{inner.height - TOP - BOTTOM}"><title>{escape(shade.name)}</title></rect>'
    )


def _mark(inner: _Inner, mark: Mark) -> str:
    on = inner.x if mark.vertical else inner.y
    if not on.low <= mark.at <= on.high:
        return ""
    if mark.vertical:
        x, _ = inner.at(mark.at, inner.y.low)
        ends = f'x1="{x:.1f}" y1="{TOP}" x2="{x:.1f}" y2="{inner.height - BOTTOM}"'
    else:
        _, y = inner.at(inner.x.low, mark.at)
        ends = f'x1="{LEFT}" y1="{y:.1f}" x2="{inner.width - RIGHT}" y2="{y:.1f}"'
    return (
        f'<g class="{mark.css}"><line class="mark" {ends}><title>{escape(mark.name)}</title>'
        "</line></g>"
    )


def _draw(inner: _Inner, series: Series) -> str:
    xs = [float(x) for x in series.xs]
    ys = [float(y) for y in series.ys]
    places: list[tuple[float, float] | None] = []
    for index in thinned(xs, ys):
        seen = math.isfinite(xs[index]) and math.isfinite(ys[index])
        places.append(inner.at(xs[index], ys[index]) if seen else None)
    if series.kind == "dots":
        dots = "".join(
            f'<circle class="dot" cx="{p[0]:.1f}" cy="{p[1]:.1f}" r="2.6"/>' for p in places if p
        )
        return f'<g class="{series.css}">{dots}</g>'
    path, pen_up = [], True
    for place in places:
        if place is not None:
            path.append(f"{'M' if pen_up else 'L'}{place[0]:.1f} {place[1]:.1f}")
        pen_up = place is None
    css = f"line {series.kind}" if series.kind in ("faint", "dashed") else "line"
    return f'<g class="{series.css}"><path class="{css}" d="{"".join(path)}"/></g>'


def wrapped(width: int, height: int, title: str, body: str) -> str:
    """A chart of its parts; the title is what a screen reader says."""
    return (
        f'<svg viewBox="0 0 {width} {height}" role="img" preserveAspectRatio="xMidYMid meet">'
        f"<title>{escape(title)}</title>{body}</svg>"
    )


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
