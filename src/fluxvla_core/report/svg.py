"""Charts as inline SVG that takes its colours from the page, so that light and dark both work.

Classes the page's style sheet gives a colour to: ``s0`` … ``s5`` (series), ``grid``, ``axis``,
``tick``, ``label``, ``good``, ``bad``, ``band``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from fluxvla_core.report.scale import Axis, axis, duration, short

LEFT, RIGHT, TOP, BOTTOM = 48, 12, 10, 34
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


def interval_chart(rows: Sequence[Interval], *, title: str, width: int = 860) -> str:
    """A dot with its interval for each row, on a common scale from 0 to 100 %."""
    # About 7 pixels a letter.
    left = max(240, 16 + 7 * max((len(row.name) for row in rows), default=0))
    right, step, top = 76, 30, 6
    height = top + step * len(rows) + 30
    span = width - left - right
    parts = []
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        x = left + share * span
        parts.append(
            f'<line class="grid" x1="{x:.1f}" y1="{top}" x2="{x:.1f}" y2="{height - 26}"/>'
            f'<text class="tick" x="{x:.1f}" y="{height - 10}" text-anchor="middle">'
            f"{share:.0%}</text>"
        )
    for number, row in enumerate(rows):
        y = top + step * number + step / 2
        x1, x, x2 = (left + share * span for share in (row.low, row.value, row.high))
        parts.append(
            f'<text class="label" x="0" y="{y + 4:.1f}">{escape(row.name)}</text>'
            f'<g class="{row.css}"><line class="band" x1="{x1:.1f}" y1="{y:.1f}" x2="{x2:.1f}" '
            f'y2="{y:.1f}"/><circle class="dot" cx="{x:.1f}" cy="{y:.1f}" r="6"/></g>'
            f'<text class="tick" x="{width}" y="{y + 4:.1f}" text-anchor="end">'
            f"{escape(row.note)}</text>"
        )
    return wrapped(width, height, title, "".join(parts))


def duration_bar(parts: Sequence[tuple[str, float]], *, title: str, width: int = 860) -> str:
    """One bar that is divided among named durations (s), and a legend with the figures."""
    total = sum(seconds for _, seconds in parts) or 1.0
    columns = 3
    height = 40 + 22 * math.ceil(len(parts) / columns)
    body, x = [], 0.0
    for number, (name, seconds) in enumerate(parts):
        share = seconds / total * width
        css = f"s{number % 6}"
        body.append(
            f'<g class="{css}"><rect class="fill" x="{x:.1f}" y="0" '
            f'width="{max(0.0, share - 1):.1f}" height="24"><title>{escape(name)}: '
            f"{duration(seconds)}</title></rect></g>"
        )
        x += share
        column, row = number % columns, number // columns
        at, y = column * width / columns, 48 + 22 * row
        body.append(
            f'<g class="{css}"><rect class="fill" x="{at:.1f}" y="{y - 10}" width="10" '
            f'height="10" rx="2"/></g><text class="label" x="{at + 16:.1f}" y="{y - 1}">'
            f"{escape(name)} · {duration(seconds)}</text>"
        )
    return wrapped(width, height, title, "".join(body))


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
