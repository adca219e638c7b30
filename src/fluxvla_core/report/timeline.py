"""What happened when in an episode, and where its time went: two charts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from fluxvla_core.report.facts import Moment, Span
from fluxvla_core.report.scale import axis, short
from fluxvla_core.report.svg import wrapped

WIDTH, LEFT, RIGHT = 860, 150, 12
PHASES = {"start": "s5", "ramp": "s3", "run": "s0", "hold": "s2", "stop": "bad"}
"""Phase -> its colour's class."""


@dataclass(frozen=True)
class StageTime:
    """A row of the budget: percentiles in ms, and what the stage is."""

    name: str
    p50: float
    p95: float
    p99: float
    what: str = ""


def timeline(
    phases: Sequence[Span],
    chunks: Sequence[float],
    clamps: Sequence[float],
    stops: Sequence[Moment],
    *,
    title: str,
) -> str:
    """One row each for phases, policy answers and clamped commands; stops go through all."""
    step, top = 24, 6
    height = top + 3 * step + 26
    times = [t for span in phases for t in (span.start, span.end)] + [m.at for m in stops]
    along = axis([*times, *chunks], count=8, tight=True)

    def x(time: float) -> float:
        return LEFT + along.place(time) * (WIDTH - LEFT - RIGHT)

    body = []
    for row, name in enumerate(("phase", f"{len(chunks)} answers", f"{len(clamps)} clamped")):
        y = top + row * step + step / 2
        body.append(f'<text class="label" x="0" y="{y + 4:.1f}">{name}</text>')
    for tick in along.ticks:
        body.append(
            f'<line class="grid" x1="{x(tick):.1f}" y1="{top}" x2="{x(tick):.1f}" '
            f'y2="{height - 24}"/><text class="tick" x="{x(tick):.1f}" y="{height - 8}" '
            f'text-anchor="middle">{short(tick)} s</text>'
        )
    for span in phases:
        wide = max(1.5, x(span.end) - x(span.start))
        body.append(
            f'<g class="{PHASES.get(span.name, "s5")}"><rect class="fill" x="{x(span.start):.1f}" '
            f'y="{top + 3}" width="{wide:.1f}" height="{step - 6}" rx="3"><title>'
            f"{escape(span.name)}: {span.end - span.start:.2f} s</title></rect></g>"
        )
        if wide > 9 * len(span.name):
            body.append(
                f'<text class="inside" x="{x(span.start) + wide / 2:.1f}" y="{top + 16}" '
                f'text-anchor="middle">{escape(span.name)}</text>'
            )
    body += [_tick(x(time), top + step, step, "s0") for time in chunks]
    body += [_tick(x(time), top + 2 * step, step, "bad") for time in clamps]
    for moment in stops:
        body.append(
            f'<g class="bad"><line class="mark" x1="{x(moment.at):.1f}" y1="{top}" '
            f'x2="{x(moment.at):.1f}" y2="{height - 24}"><title>{escape(moment.name)}: '
            f"{escape(moment.text)}</title></line></g>"
        )
    return wrapped(WIDTH, height, title, "".join(body))


def budget_chart(rows: Sequence[StageTime], *, title: str) -> str:
    """For each stage three bars over one another: median, 95 % and 99 %, in ms."""
    step, top, numbers = 30, 20, 190
    height = top + step * len(rows) + 4
    most = max((row.p99 for row in rows if math.isfinite(row.p99)), default=0.0) or 1.0
    span = WIDTH - LEFT - numbers
    body = [
        f'<text class="tick" x="{WIDTH - numbers + place}" y="11" text-anchor="end">{name}</text>'
        for name, place in (("median", 62), ("95 %", 124), ("99 %", 186))
    ]
    for number, row in enumerate(rows):
        y = top + step * number
        body.append(
            f'<text class="label" x="0" y="{y + 18}">{escape(row.name)}<title>'
            f"{escape(row.what)}</title></text>"
        )
        for value, css in ((row.p99, "p99"), (row.p95, "p95"), (row.p50, "p50")):
            wide = max(1.5, value / most * span) if math.isfinite(value) else 0.0
            body.append(
                f'<g class="s0"><rect class="fill {css}" x="{LEFT}" y="{y + 6}" '
                f'width="{wide:.1f}" height="{step - 14}" rx="3"/></g>'
            )
        for value, place in ((row.p50, 62), (row.p95, 124), (row.p99, 186)):
            body.append(
                f'<text class="tick" x="{WIDTH - numbers + place}" y="{y + 18}" '
                f'text-anchor="end">{milliseconds(value)}</text>'
            )
    return wrapped(WIDTH, height, title, "".join(body))


def milliseconds(value: float) -> str:
    """``12.3 ms``; a dash for what was not measured."""
    if not math.isfinite(value):
        return "–"
    return f"{value:.{0 if value >= 100 else 1 if value >= 1 else 2}f} ms"


def _tick(x: float, top: float, step: int, css: str) -> str:
    return (
        f'<g class="{css}"><line class="tick-line" x1="{x:.1f}" y1="{top + 5}" x2="{x:.1f}" '
        f'y2="{top + step - 5}"/></g>'
    )
