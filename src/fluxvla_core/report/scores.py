"""Success rates and videos of evaluations, from ``results.json`` and ``episodes.jsonl``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fluxvla_core.report.facts import Evaluation, Group, Score, Video
from fluxvla_core.report.files import Reader, mappings, number

NAMES = {
    "policy": "trained policy",
    "swapped": "told the other task",
    "untrained": "untrained policy",
    "expert": "scripted expert",
}
"""What people call the groups of an evaluation; an unknown one keeps its own name."""


def read_evaluations(reader: Reader, work_dir: Path) -> list[Evaluation]:
    """Every ``results.json`` in a folder of the work dir that has success rates in it."""
    found = [
        _evaluation(reader, path.parent, reader.mapping(path))
        for path in sorted(work_dir.glob("*/results.json"))
    ]
    return [evaluation for evaluation in found if evaluation.groups]


def _evaluation(reader: Reader, folder: Path, results: Mapping[str, Any]) -> Evaluation:
    groups = [_group(name, table) for name, table in mappings(results.get("groups"))]
    records = [r for r in reader.lines(folder / "episodes.jsonl") if r.get("status") == "done"]
    return Evaluation(
        name=folder.name,
        groups=[group for group in groups if group is not None],
        videos=_videos(folder, records),
        details={
            name: value
            for name, value in results.items()
            if name not in ("groups", "format") and not isinstance(value, (dict, list))
        },
    )


def _group(name: str, table: Mapping[str, Any]) -> Group | None:
    total = _score("all tasks", table.get("all"))
    if total is None:
        return None
    scores = [_score(task, counted) for task, counted in mappings(table.get("tasks"))]
    tasks = [score for score in scores if score is not None]
    return Group(name, NAMES.get(name, name), total, tasks)


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


def _videos(folder: Path, records: list[dict[str, Any]]) -> list[Video]:
    """Videos that records name; of the trained policy first, its failures before all."""
    videos = []
    for record in records:
        named = record.get("video")
        path = folder / str(named) if named else None
        if path is None or not path.is_file():
            continue
        group = str(record.get("group", ""))
        caption = (
            f"{record.get('task', '')} · {NAMES.get(group, group)} · seed {record.get('seed')}"
        )
        success = bool(record.get("success"))
        order = (list(NAMES).index(group) if group in NAMES else len(NAMES), success)
        videos.append((order, Video(path, caption, success)))
    return [video for _, video in sorted(videos, key=lambda pair: pair[0])]
