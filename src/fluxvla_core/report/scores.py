"""Success rates, behaviours and videos of evaluations, from their ``results.json``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fluxvla_core.report.facts import Behaviour, Evaluation, Group, Score, Video
from fluxvla_core.report.files import Reader, mappings, number

NAMES = {
    "policy": "trained policy",
    "swapped": "told the other task",
    "untrained": "untrained policy",
}
"""What people call the groups of an evaluation; an unknown one keeps its own name."""

MODES = {"robot": ", on the robot", "live": ", in real time"}
"""What is added where the policy did not have all the time in the world."""


def read_evaluations(reader: Reader, work_dir: Path) -> list[Evaluation]:
    """Every ``results.json`` in a folder of the work dir that has success rates in it."""
    found = [
        _evaluation(path.parent, reader.mapping(path))
        for path in sorted(work_dir.glob("*/results.json"))
    ]
    return [evaluation for evaluation in found if evaluation.groups]


def _evaluation(folder: Path, results: Mapping[str, Any]) -> Evaluation:
    names = dict(NAMES)
    if results.get("policy") not in (None, "checkpoint"):
        names["policy"] = f"{results['policy']} policy"
    names = {name: text + MODES.get(str(results.get("mode")), "") for name, text in names.items()}
    groups = [_group(name, names, table) for name, table in mappings(results.get("groups"))]
    return Evaluation(
        name=folder.name,
        groups=[group for group in groups if group is not None],
        problems=_problems(names, results.get("problems")),
        behaviours=_behaviours(names, results.get("behaviours")),
        videos=_videos(folder, names, results.get("videos")),
        details=_details(results),
        live=results.get("mode") == "live",
    )


def _group(name: str, names: Mapping[str, str], table: Mapping[str, Any]) -> Group | None:
    total = _score("all tasks", table.get("all"))
    if total is None:
        return None
    scores = [_score(task, counted) for task, counted in mappings(table.get("tasks"))]
    tasks = [score for score in scores if score is not None]
    return Group(name, names.get(name, name), total, tasks)


def _score(name: str, counted: Any) -> Score | None:
    if not isinstance(counted, Mapping) or not number(counted.get("episodes")) > 0:
        return None
    return Score(
        task=name,
        successes=int(number(counted.get("successes", 0))),
        episodes=int(counted["episodes"]),
        low=number(counted.get("low")),
        high=number(counted.get("high")),
        errors=int(number(counted.get("errors", 0))),
    )


def _problems(names: Mapping[str, str], listed: Any) -> list[str]:
    """Lines for people; episodes without a result are among nobody's successes or failures."""
    lines = []
    for row in listed if isinstance(listed, list) else []:
        if isinstance(row, Mapping):
            count, group = int(number(row.get("episodes", 0))), str(row.get("group"))
            became = "failed" if row.get("status") == "done" else "gave no result"
            many = "1 episode" if count == 1 else f"{count} episodes"
            lines.append(f"{names.get(group, group)}: {many} {became}: {row.get('what')}")
    return lines


def _behaviours(names: Mapping[str, str], table: Any) -> list[Behaviour]:
    return [
        Behaviour(
            group=names.get(group, group),
            instruction=instruction,
            episodes=int(number(row.get("episodes", 0))),
            counts={name: int(number(count)) for name, count in row.items() if name != "episodes"},
        )
        for group, said in mappings(table)
        for instruction, row in mappings(said)
    ]


def _videos(folder: Path, names: Mapping[str, str], listed: Any) -> list[Video]:
    """The videos that are there, in the order of the results: failures come first in it."""
    rows = [row for row in listed if isinstance(row, Mapping)] if isinstance(listed, list) else []
    return [
        Video(
            path=folder / str(row["path"]),
            caption=f"{row.get('task', '')} · seed {row.get('seed', '?')} · "
            f"{names.get(str(row.get('group')), row.get('group', ''))}",
            success=bool(row.get("success")),
        )
        for row in rows
        if row.get("path") and (folder / str(row["path"])).is_file()
    ]


def _details(results: Mapping[str, Any]) -> dict[str, Any]:
    """Rows on how the numbers came about: checkpoint, speed, settings."""
    tables = dict(mappings(results))
    checkpoint, timing = tables.get("checkpoint", {}), tables.get("timing", {})
    rows: dict[str, Any] = {"checkpoint": checkpoint.get("path"), "step": checkpoint.get("step")}
    if timing.get("episodes"):
        rows["speed"] = (
            f"{number(timing.get('steps_per_s')):.0f} steps/s in {timing.get('workers')} "
            f"processes, {timing['episodes']} episodes in {number(timing.get('seconds')):.0f} s"
        )
    live = tables.get("live", {})
    if live:
        stopped = ", ".join(f"{rule} {n}" for rule, n in dict(live.get("stopped_by", {})).items())
        rows["on the wall clock"] = (
            f"{number(live.get('missed_share')):.1%} of {live.get('ticks')} ticks without a target "
            f"of the policy; stopped by safety: {stopped or 'none'}"
        )
    if "policy_ms" in timing:
        rows["the policy's answer"] = f"{number(timing['policy_ms']):.1f} ms on average"
    return {**rows, **tables.get("settings", {})}
