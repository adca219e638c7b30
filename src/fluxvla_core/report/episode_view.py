"""An episode as the page shows it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from fluxvla_core.report.facts import Episode, JointTrace, Video
from fluxvla_core.report.files import number, text_rows
from fluxvla_core.report.svg import Mark, Series, Shade, line_chart
from fluxvla_core.report.timeline import StageTime, budget_chart, milliseconds, timeline

# Joint plots show at least this much (rad, m or gripper units).
LEAST_RANGE = 0.1
STAGES: Mapping[str, str] = {
    "receipt": "how old the oldest stream was when the robot was looked at",
    "sync": "gathering state and pictures that belong together",
    "preprocess": "making the policy's input of them",
    "inference": "the model",
    "postprocess": "making joint targets of its output",
    "policy": "asking the policy, as a whole",
    "send": "handing one command to the robot",
}
"""Stage -> what it is, in the order of a picture's way to a command."""


def episode_view(episode: Episode, put: Callable[[Video], Mapping[str, Any]]) -> dict[str, Any]:
    """What the template is given; ``put`` makes the source of a video."""
    clamped = sorted({time for joint in episode.joints for time, _ in joint.clamped})
    happened = bool(episode.phases)
    return {
        "facts": episode,
        "line": headline(episode),
        "timeline": timeline(
            episode.phases, episode.chunks, clamped, episode.stops, title="What happened when"
        )
        if happened
        else "",
        "joints": [joint_chart(joint, episode) for joint in episode.joints],
        "budget": budget_chart(budget, title="Latency by stage")
        if (budget := stage_times(episode))
        else "",
        "stages": STAGES,
        "total": None if (total := total_ms(episode)) is None else milliseconds(total),
        "rows": text_rows(episode.notes.items()),
        "videos": [put(video) for video in episode.videos],
    }


def headline(episode: Episode) -> str:
    """How it went, in one line."""
    parts = [f"ended: {episode.outcome}"]
    if episode.joints:
        count = len(episode.joints[0].times)
        parts.append(f"{count} commands in {episode.seconds:.1f} s")
        parts.append(f"{episode.clamped} changed by a limit" if episode.clamped else "none clamped")
    robot = episode.notes.get("robot")
    return " · ".join([*parts, *([str(robot)] if robot else [])])


def joint_chart(joint: JointTrace, episode: Episode) -> dict[str, Any]:
    """One joint's targets, commands, states and clamps, with the stops and the limits."""
    times, values = [t for t, _ in joint.clamped], [v for _, v in joint.clamped]
    series = [
        Series("target", joint.times, joint.wanted, css="s5", kind="dashed"),
        Series("state", joint.times, joint.states, css="s1"),
        Series("command", joint.times, joint.commands, css="s0"),
        Series("clamped", times, values, css="bad", kind="dots"),
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
    """The budget's rows; the policy as a whole only where it does not tell its stages."""
    found = []
    for name, what in STAGES.items():
        row = episode.timings.get(name)
        if row is None or (name == "policy" and "inference" in episode.timings):
            continue
        p50, p95, p99 = (number(row.get(key)) for key in ("p50_ms", "p95_ms", "p99_ms"))
        found.append(StageTime(name, p50, p95, p99, what))
    return found


def total_ms(episode: Episode) -> float | None:
    """From a picture's arrival to the command that follows from it: the sum of the medians."""
    rows = stage_times(episode)
    return sum(row.p50 for row in rows) if len(rows) > 1 else None
