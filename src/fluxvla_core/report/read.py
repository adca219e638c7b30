"""From the files of a work dir to the facts of a report. Whatever is missing stays empty."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fluxvla_core.report.facts import Episode, Facts, JointTrace, Stage, Training, Video
from fluxvla_core.report.files import Reader, mappings, number
from fluxvla_core.report.scores import read_evaluations

STAGES = "stages.json"
"""``{"stages": [{"name": …, "seconds": …, "command": …}]}``: what a larger job (the demo) notes of
its parts, for the report to show."""


def read_facts(work_dir: Path) -> Facts:
    """Everything of a run that its work dir holds; problems are listed, never raised."""
    reader = Reader(work_dir)
    resolved = reader.mapping(work_dir / "config.resolved.json")
    config = resolved.get("config", {})
    units = read_units(reader, work_dir / "checkpoints")
    return Facts(
        work_dir=work_dir,
        training=read_training(reader, work_dir / "metrics.jsonl"),
        evaluations=read_evaluations(reader, work_dir),
        episodes=read_episodes(reader, work_dir / "inference", units),
        stages=read_stages(reader, work_dir / STAGES),
        dataset=read_dataset(reader, config),
        config=resolved,
        environment=reader.mapping(work_dir / "environment.json"),
        problems=tuple(reader.problems),
    )


def read_training(reader: Reader, path: Path) -> Training | None:
    """The logged steps, in order; None when there are none."""
    rows = [row for row in reader.lines(path) if math.isfinite(number(row.get("step")))]
    if not rows:
        return None
    names = dict.fromkeys(name for row in rows for name in row if name != "step")
    columns = {name: [number(row.get(name)) for row in rows] for name in names}
    return Training([number(row["step"]) for row in rows], columns)


def read_stages(reader: Reader, path: Path) -> list[Stage]:
    """The parts of a larger job with their durations."""
    found = reader.mapping(path).get("stages", [])
    rows = [row for row in found if isinstance(row, Mapping)] if isinstance(found, list) else []
    return [
        Stage(str(row.get("name", "?")), number(row.get("seconds")), str(row.get("command", "")))
        for row in rows
        if math.isfinite(number(row.get("seconds")))
    ]


def read_dataset(reader: Reader, config: Mapping[str, Any]) -> dict[str, Any]:
    """What the metadata of the training data say, if the data are where the config says."""
    loader = dict(mappings(config)).get("train_dataloader", {})
    root = dict(mappings(loader)).get("dataset", {}).get("data_root_path")
    if not isinstance(root, str):
        return {}
    info = reader.mapping(Path(root) / "meta" / "info.json")
    return {"path": root, **info} if info else {}


def read_units(reader: Reader, checkpoints: Path) -> dict[str, str]:
    """Joint -> unit, as the newest checkpoint's embodiment states them."""
    folders = sorted(p for p in checkpoints.glob("*") if (p / "embodiment.json").is_file())
    if not folders:
        return {}
    joints = reader.mapping(folders[-1] / "embodiment.json").get("joints", [])
    rows = [row for row in joints if isinstance(row, Mapping)]
    return {str(row.get("name")): str(row.get("unit", "")) for row in rows}


def read_episodes(reader: Reader, folder: Path, units: Mapping[str, str]) -> list[Episode]:
    """Inference episodes, newest last; those without a single command have no joint plots."""
    found = sorted(path.parent for path in folder.glob("*/episode.json"))
    return [_episode(reader, path, units) for path in found]


def _episode(reader: Reader, folder: Path, units: Mapping[str, str]) -> Episode:
    summary = reader.mapping(folder / "episode.json")
    events = reader.lines(folder / "trace.jsonl")
    success = summary.get("success")
    outcome = str(summary.get("outcome", "unknown"))
    instruction = str(summary.get("instruction", ""))
    return Episode(
        name=folder.name,
        task=instruction,
        outcome=outcome,
        success=success if isinstance(success, bool) else None,
        joints=joint_traces(summary.get("joints", []), events, units),
        timings={name: dict(row) for name, row in mappings(summary.get("timings"))},
        videos=[
            Video(path, f"{instruction} · camera {path.stem}", success)
            for path in sorted(folder.glob("*.mp4"))
        ],
        notes={
            "problem": summary.get("problem"),
            "robot": summary.get("robot"),
            "commands": summary.get("steps"),
            "rate": f"{summary['rate_hz']:g} Hz" if "rate_hz" in summary else None,
            "chunks of the policy": summary.get("chunks"),
            "beats that were skipped": summary.get("skipped_beats"),
            "beats without a target": summary.get("held_beats"),
            "trips": "; ".join(_trip(row) for row in summary.get("trips", [])),
            "clamped commands": clamp_counts(summary.get("clamps")),
        },
    )


def joint_traces(
    names: Sequence[str], events: Sequence[Mapping[str, Any]], units: Mapping[str, str]
) -> list[JointTrace]:
    """One trace a joint from a trace's ``command`` events; time starts at the first of them."""
    commands = [
        event
        for event in events
        if event.get("event") == "command" and len(event.get("command") or ()) == len(names)
    ]
    if not commands or not names:
        return []
    start = number(commands[0].get("t"))
    times = [number(event.get("t")) - start for event in commands]
    traces = []
    for column, name in enumerate(names):
        clamped = [
            (time, number(event["command"][column]))
            for time, event in zip(times, commands, strict=True)
            if any(clamp.get("joint") == name for clamp in event.get("clamps") or ())
        ]
        traces.append(
            JointTrace(
                name=name,
                unit=units.get(name, ""),
                times=times,
                commands=[number(event["command"][column]) for event in commands],
                states=[_entry(event.get("state"), column, len(names)) for event in commands],
                clamped=clamped,
            )
        )
    return traces


def clamp_counts(clamps: Any) -> str:
    """``right_elbow 12 (velocity), …`` from joint -> reason -> count."""
    parts = [
        f"{joint} {sum(map(int, reasons.values()))} ({', '.join(reasons)})"
        for joint, reasons in mappings(clamps)
        if reasons
    ]
    return ", ".join(parts) or "none"


def _entry(values: Any, column: int, width: int) -> float:
    # A robot whose state has other joints than its action cannot be drawn against it by place.
    if not isinstance(values, list) or len(values) != width:
        return float("nan")
    return number(values[column])


def _trip(row: Any) -> str:
    return f"{row.get('rule')}: {row.get('what')}" if isinstance(row, Mapping) else str(row)
