"""The view of one recorded episode: timeline, joint plots, latency by stage."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from fluxvla_report.facts import Episode, JointTrace, Moment, Span, Video
from fluxvla_report.files import number, text_rows
from fluxvla_report.svg import (
    ROW_HEIGHT,
    Axis,
    Mark,
    Row,
    Series,
    Shade,
    axis,
    line_chart,
    percent,
    rows_chart,
    short,
)

# Joint plots show at least this much (rad, m or gripper units).
LEAST_RANGE = 0.1
STAGES: Mapping[str, str] = {
    "receipt": "how old the oldest stream was when the robot was read",
    "sync": "matching state and images in time",
    "preprocess": "making the policy's input",
    "inference": "the model",
    "postprocess": "making joint targets from its output",
    "policy": "the policy call as a whole",
    "send": "handing one command to the robot",
}
"""Stage -> what it is, in the order from an image to a command."""


def episode_view(episode: Episode, put: Callable[[Video], Mapping[str, Any]]) -> dict[str, Any]:
    """The values for the template; ``put`` makes the source of a video."""
    clamped = sorted({time for joint in episode.joints for time, _ in joint.clamped})
    happened = bool(episode.phases)
    return {
        "facts": episode,
        "line": headline(episode),
        "timeline": timeline(
            episode.phases,
            episode.chunks,
            clamped,
            episode.stops,
            title="Timeline",
            clamp_css=clamp_css(episode),
        )
        if happened
        else "",
        "joints": [joint_chart(joint, episode) for joint in episode.joints if drawable(joint)],
        "budget": budget_chart(budget, title="Latency by stage")
        if (budget := stage_times(episode))
        else "",
        "legend": legend(episode),
        "clamp_note": clamp_note(episode),
        "stages": STAGES,
        "total": None if (total := total_ms(episode)) is None else milliseconds(total),
        "rows": text_rows(episode.notes.items()),
        "videos": [put(video) for video in episode.videos],
    }


def headline(episode: Episode) -> str:
    """The outcome of an episode in one line."""
    parts = [f"ended: {episode.outcome}"]
    if episode.joints:
        count = len(episode.joints[0].times)
        parts.append(f"{count} commands in {episode.seconds:.1f} s")
        parts.append(f"{episode.clamped} changed by a limit" if episode.clamped else "none clamped")
    robot = episode.notes.get("robot")
    return " · ".join([*parts, *([str(robot)] if robot else [])])


def drawable(joint: JointTrace) -> bool:
    """Whether there is a line to draw."""
    return len(joint.times) > 1


def clamp_css(episode: Episode) -> str:
    """The colour of clamped commands: neutral after a success, else that of problems."""
    return "bad" if episode.stops or episode.success is False else "s3"


def clamp_note(episode: Episode) -> str:
    """Text: which joints' commands a limit changed, and what that means."""
    counts = {joint.name: len(joint.clamped) for joint in episode.joints if joint.clamped}
    if not counts:
        return ""
    total, most = episode.clamped, sorted(counts, key=lambda name: -counts[name])[:3]
    whose = ", ".join(f"{counts[name]} {name}" for name in most)
    more = f" and {len(counts) - len(most)} more" if len(counts) > len(most) else ""
    grippers = [joint.name for joint in episode.joints if joint.gripper]
    pressed = sum(counts.get(name, 0) for name in grippers)
    text = (
        f"A limit changed {total} of {len(episode.joints[0].times)} commands ({whose}{more}): the "
        "joint went as fast as it may towards its target, or as far as it may."
    )
    if pressed > sum(counts.values()) / 2:
        text += (
            " Most are a gripper's: its command jumps between open and closed, and it takes time."
        )
    return text


def legend(episode: Episode) -> list[tuple[str, str]]:
    """Classes and text of what is drawn in the joints' charts."""
    joints = episode.joints
    entries = [("s0", "command")]
    if any(map(math.isfinite, (v for joint in joints for v in joint.states))):
        entries.append(("s1", "state"))
    if any(map(math.isfinite, (v for joint in joints for v in joint.wanted))):
        entries.append(("dash s5", "target before the limits"))
    if episode.clamped:
        entries.append((f"dot {clamp_css(episode)}", "command that a limit changed"))
    if episode.stops:
        entries.append(("bar bad", "safe stop"))
    if any(joint.limits for joint in joints):
        entries.append(("limit s5", "limit of the joint"))
    if any(span.name != "run" for span in episode.phases):
        entries.append(("area", "not the task: ramp, hold, stop"))
    return entries


def joint_chart(joint: JointTrace, episode: Episode) -> dict[str, Any]:
    """One joint's targets, commands, states and clamps, with the stops and the limits."""
    times, values = [t for t, _ in joint.clamped], [v for _, v in joint.clamped]
    series = [
        Series("target", joint.times, joint.wanted, css="s5", kind="dashed"),
        Series("state", joint.times, joint.states, css="s1"),
        Series("command", joint.times, joint.commands, css="s0"),
        Series("clamped", times, values, css=clamp_css(episode), kind="dots"),
    ]
    low, high = joint.limits or (float("nan"), float("nan"))
    marks = [Mark(at, f"limit {at:g} {joint.unit}", "s5", vertical=False) for at in (low, high)]
    marks += [Mark(stop.at, f"{stop.name}: {stop.text}") for stop in episode.stops]
    chart = line_chart(
        [s for s in series if len(s.ys) == len(s.xs)],
        x_label="s",
        title=f"{joint.name}: command and state",
        least=LEAST_RANGE,
        width=340,
        height=150,
        shades=[Shade(p.name, p.start, p.end) for p in episode.phases if p.name != "run"],
        marks=marks,
    )
    return {"name": joint.name, "unit": joint.unit, "svg": chart, "clamps": len(times)}


def stage_times(episode: Episode) -> list[StageTime]:
    """The budget's rows; the policy as a whole only if it does not report its stages."""
    found: list[StageTime] = []
    if episode.simulated:
        return found
    for name, what in STAGES.items():
        row = episode.timings.get(name)
        if row is None or (name == "policy" and "inference" in episode.timings):
            continue
        p50, p95, p99 = (number(row.get(key)) for key in ("p50_ms", "p95_ms", "p99_ms"))
        found.append(StageTime(name, p50, p95, p99, what))
    return found


def total_ms(episode: Episode) -> float | None:
    """From an image's arrival to the command that follows from it: the sum of the medians."""
    rows = stage_times(episode)
    return sum(row.p50 for row in rows) if len(rows) > 1 else None


NARROW = 330  # pixels of a row's drawing on a telephone
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
    clamp_css: str = "bad",
) -> str:
    """One row each for phases, policy answers and clamped commands; stops go through all.

    A row with nothing in it is left out.
    """
    times = [t for span in phases for t in (span.start, span.end)] + [m.at for m in stops]
    along = axis([*times, *chunks], count=6, tight=True)
    stopped = "".join(
        f'<g class="bad"><line class="mark" x1="{percent(along.place(moment.at))}" y1="0" '
        f'x2="{percent(along.place(moment.at))}" y2="{ROW_HEIGHT}"><title>{escape(moment.name)}: '
        f"{escape(moment.text)}</title></line></g>"
        for moment in stops
    )
    rows = [Row("phase", "".join(_phase(span, along) for span in phases) + stopped)]
    for moments, what, css in ((chunks, "answers", "s0"), (clamps, "clamped", clamp_css)):
        if moments:
            rows.append(Row(f"{len(moments)} {what}", _ticks(moments, along, css) + stopped))
    scale = [(along.place(tick), f"{short(tick)} s") for tick in along.ticks]
    return rows_chart(rows, title=title, ticks=scale)


def _phase(span: Span, along: Axis) -> str:
    start = along.place(span.start)
    share = max(0.002, along.place(span.end) - start)
    bar = (
        f'<g class="{PHASES.get(span.name, "s5")}"><rect class="fill" x="{percent(start)}" y="3" '
        f'width="{percent(share)}" height="{ROW_HEIGHT - 6}" rx="3"><title>'
        f"{escape(span.name)}: {span.end - span.start:.2f} s</title></rect></g>"
    )
    if share * NARROW <= 9 * len(span.name):
        return bar
    return (
        f'{bar}<text class="inside" x="{percent(start + share / 2)}" y="17" '
        f'text-anchor="middle">{escape(span.name)}</text>'
    )


def _ticks(times: Sequence[float], along: Axis, css: str) -> str:
    places = [percent(along.place(time)) for time in times]
    lines = (
        f'<line class="tick-line" x1="{x}" y1="5" x2="{x}" y2="{ROW_HEIGHT - 5}"/>' for x in places
    )
    return f'<g class="{css}">{"".join(lines)}</g>'


def budget_chart(rows: Sequence[StageTime], *, title: str) -> str:
    """Latency by stage as HTML: bars of the median, 95 % and 99 %, in ms."""
    most = max((row.p99 for row in rows if math.isfinite(row.p99)), default=0.0) or 1.0
    drawn = [Row("", "", ("median", "95 %", "99 %"))]
    for row in rows:
        bars = "".join(
            f'<rect class="fill {css}" x="0" y="6" width="{percent(max(0.002, value / most))}" '
            f'height="{ROW_HEIGHT - 12}" rx="3"/>'
            for value, css in ((row.p99, "p99"), (row.p95, "p95"), (row.p50, "p50"))
            if math.isfinite(value)
        )
        figures = tuple(milliseconds(value) for value in (row.p50, row.p95, row.p99))
        drawn.append(Row(row.name, f'<g class="s0">{bars}</g>', figures, row.what))
    return rows_chart(drawn, title=title)


def milliseconds(value: float) -> str:
    """``12.3 ms``; a dash for what was not measured."""
    if not math.isfinite(value):
        return "–"
    return f"{value:.{0 if value >= 100 else 1 if value >= 1 else 2}f} ms"
