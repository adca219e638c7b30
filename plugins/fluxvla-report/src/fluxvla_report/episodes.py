"""Read recorded episodes for a report; they may be complete, cut short or damaged."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from fluxvla_core.errors import FluxError
from fluxvla_core.results import (
    EVENTS_FILE,
    SUMMARY_FILE,
    bag_of,
    episode_log,
    is_recording,
    read_bag,
)
from fluxvla_report.facts import Episode, JointTrace, Moment, Span, Video
from fluxvla_report.files import Reader, mappings, number

Event = Mapping[str, Any]
FOLDER = "inference"


def read_episodes(reader: Reader, root: Path) -> list[Episode]:
    """Every episode of a work dir, of a folder of recordings, or the one recorded there.

    Newest last. One without a single command has no joint plots.
    """
    if is_recording(root) or (root / SUMMARY_FILE).is_file():
        return [_episode(reader, root)]
    places = [path for folder in (root / FOLDER, root) for path in sorted(folder.glob("*/"))]
    found = [p for p in places if is_recording(p) or (p / SUMMARY_FILE).is_file()]
    return [_episode(reader, path) for path in found]


def _episode(reader: Reader, folder: Path) -> Episode:
    events = _events(reader, folder)
    summary = reader.mapping(folder / SUMMARY_FILE)
    counted = episode_log.summarise(events)
    # What a process wrote that was killed has no summary; it is counted from what there is.
    summary = summary or counted
    start = events[0] if events and events[0].get("event") == episode_log.START else {}
    first = next((number(e.get("t")) for e in events if e.get("event") == episode_log.COMMAND), 0.0)
    success = summary.get("success")
    instruction = str(summary.get("instruction") or "")
    return Episode(
        name=folder.name,
        task=instruction,
        outcome=str(summary.get("outcome", "unknown")),
        success=success if isinstance(success, bool) else None,
        joints=joint_traces(summary.get("joints", []), events, joint_facts(start)),
        timings={name: dict(row) for name, row in mappings(summary.get("timings"))},
        videos=[
            Video(path, f"{instruction} · camera {path.stem}", success)
            for path in sorted(folder.glob("*.mp4"))
            if path.is_file()
        ],
        problem=str(summary.get("problem") or ""),
        phases=phases(events, first),
        chunks=[number(e.get("t")) - first for e in events if e.get("event") == episode_log.CHUNK],
        stops=stops(events, first),
        simulated=bool(start.get("lockstep", summary.get("lockstep"))),
        notes={
            **_notes(summary, start),
            "trips while it was held": _trips(reader.lines(folder / episode_log.HELD)),
        },
    )


def _events(reader: Reader, folder: Path) -> Sequence[Event]:
    bag = bag_of(folder)
    if bag is None:
        return reader.lines(folder / EVENTS_FILE)
    try:
        return read_bag(bag).events
    except FluxError as error:
        reader.problem(bag, error.what)
        return []


def _notes(summary: Mapping[str, Any], start: Event) -> dict[str, Any]:
    began = start.get("began")
    # Version 0.1 wrote the keys on the right.
    dropped = {
        {"pictures": "images"}.get(kind, kind): count
        for kind, count in (summary.get("dropped") or {}).items()
        if count
    }
    return {
        "began": datetime.fromtimestamp(began, timezone.utc).strftime("%Y-%m-%d %H:%M:%S UTC")
        if isinstance(began, (int, float))
        else None,
        "robot": summary.get("robot"),
        "policy": " of ".join(filter(None, (start.get("policy"), start.get("policy_source")))),
        "commands": summary.get("steps"),
        "rate": f"{summary['rate_hz']:g} Hz" if summary.get("rate_hz") else None,
        "chunks of the policy": summary.get("chunks"),
        "seed": summary.get("seed"),
        "control ticks skipped": summary.get("skipped_ticks", summary.get("skipped_beats")),
        "control ticks without a chunk, held": summary.get("held_ticks", summary.get("held_beats")),
        "trips": _trips(summary.get("trips", [])),
        "clamped commands": clamp_counts(summary.get("clamps")),
        "commands without a late filter": _late_filters(summary.get("late_filters")),
        "not recorded": ", ".join(f"{count} {what}" for what, count in dropped.items()),
    }


def joint_facts(start: Event) -> dict[str, Mapping[str, Any]]:
    """Joint -> its unit and limits, as the start event's embodiment has them."""
    joints = (start.get("embodiment") or {}).get("joints", [])
    return {str(row["name"]): row for row in joints if isinstance(row, Mapping) and "name" in row}


def joint_traces(
    names: Sequence[str], events: Sequence[Event], facts: Mapping[str, Mapping[str, Any]]
) -> list[JointTrace]:
    """One trace a joint from ``command`` events; time starts at the first of them.

    A state that was not read at a command is the one before.
    """
    width, state = len(names), None
    rows: list[tuple[Event, list[Any] | None]] = []
    for event in events:
        # A robot whose state has other joints than its action cannot be drawn against it by place.
        if isinstance(event.get("state"), list):
            state = event["state"] if len(event["state"]) == width else None
        if event.get("event") == episode_log.COMMAND and len(event.get("command") or ()) == width:
            rows.append((event, state))
    if not rows or not names:
        return []
    start = number(rows[0][0].get("t"))
    times = [number(event.get("t")) - start for event, _ in rows]
    traces = []
    for column, name in enumerate(names):
        commands = [number(event["command"][column]) for event, _ in rows]
        fact = facts.get(name, {})
        limits = number(fact.get("lower")), number(fact.get("upper"))
        traces.append(
            JointTrace(
                name=name,
                unit=str(fact.get("unit", "")),
                times=times,
                commands=commands,
                states=[_entry(seen, column) for _, seen in rows],
                clamped=[
                    (time, command)
                    for time, command, (event, _) in zip(times, commands, rows, strict=True)
                    if any(clamp.get("joint") == name for clamp in event.get("clamps") or ())
                ],
                wanted=[_entry(event.get("wanted"), column) for event, _ in rows],
                limits=limits if "lower" in fact and "upper" in fact else None,
                gripper=fact.get("kind") == "gripper",
            )
        )
    return traces


def phases(events: Sequence[Event], first: float) -> list[Span]:
    """Stretches of commands of one phase."""
    commands = [e for e in events if e.get("event") == episode_log.COMMAND]
    found: list[Span] = []
    for name, run in itertools.groupby(commands, lambda e: str(e.get("phase", ""))):
        times = [number(event.get("t")) - first for event in run]
        begin = found[-1].end if found else times[0]
        found.append(Span(name, begin, times[-1]))
    return found


def stops(events: Sequence[Event], first: float) -> list[Moment]:
    """The safe stops, with the rule that each was of."""
    return [
        Moment(
            number(event.get("t")) - first - number(event.get("seconds") or 0.0),
            str(event.get("rule", "")),
            str(event.get("problem") or ""),
        )
        for event in events
        if event.get("event") == episode_log.STOP
    ]


def clamp_counts(clamps: Any) -> str:
    """``right_elbow 12 (velocity), …`` from joint -> reason -> count."""
    parts = [
        f"{joint} {sum(map(int, reasons.values()))} ({', '.join(reasons)})"
        for joint, reasons in mappings(clamps)
        if reasons
    ]
    return ", ".join(parts) or "none"


def _late_filters(counts: Any) -> str:
    """``Slow 3, …`` from filter -> count; nothing where none was late."""
    found = counts.items() if isinstance(counts, Mapping) else ()
    return ", ".join(f"{name} {count}" for name, count in found)


def _entry(values: Any, column: int) -> float:
    known = isinstance(values, list) and column < len(values)
    return number(values[column]) if known else float("nan")


def _trips(rows: Sequence[Any]) -> str:
    return "; ".join(map(_trip, rows))


def _trip(row: Any) -> str:
    return f"{row.get('rule')}: {row.get('what')}" if isinstance(row, Mapping) else str(row)
