"""Read a work dir: metrics, evaluation results, stages, dataset; missing files are skipped."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fluxvla_report.episodes import read_episodes
from fluxvla_report.facts import Behaviour, Evaluation, Facts, Group, Score, Stage, Training, Video
from fluxvla_report.files import Reader, mappings, number

STAGES = "stages.json"
"""``{"stages": [{"name": …, "seconds": …, "command": …}]}``: what a larger job (the demo) notes of
its parts, for the report to show."""


def read_facts(work_dir: Path) -> Facts:
    """Everything of a run that its work dir holds; problems are listed, never raised."""
    reader = Reader(work_dir)
    resolved = reader.mapping(work_dir / "config.resolved.json")
    config = resolved.get("config", {})
    return Facts(
        work_dir=work_dir,
        training=read_training(reader, work_dir / "metrics.jsonl"),
        evaluations=read_evaluations(reader, work_dir),
        episodes=read_episodes(reader, work_dir),
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
    """The metadata of the training data, if the data are where the config says."""
    loader = dict(mappings(config)).get("train_dataloader", {})
    root = dict(mappings(loader)).get("dataset", {}).get("data_root_path")
    if not isinstance(root, str):
        return {}
    info = reader.mapping(Path(root) / "meta" / "info.json")
    return {"path": root, **info} if info else {}


NAMES = {
    "policy": "trained policy",
    "swapped": "wrong instruction",
    "untrained": "untrained policy",
}
"""Labels of the groups of an evaluation; an unknown one keeps its own name."""

MODES = {"robot": ", on the robot", "live": ", in real time"}
"""Suffix of the labels of an evaluation that did not wait for the policy."""

NAMED_VERSIONS = (
    "fluxvla",
    "torch",
    "mujoco",
    "dm-control",
    "gym",
    "libero",
    "robosuite",
    "metaworld",
)
"""Parts of names: distributions whose versions are read at a glance, ours and simulators."""


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
        made=_made(dict(mappings(results)).get("provenance", {})),
        live=results.get("mode") == "live",
        unseen=dict(mappings(results)).get("provenance", {}).get("unseen_seeds") is True,
        obeyed={
            name: score
            for name, counted in mappings(results.get("obeyed"))
            if (score := _score("all tasks", counted)) is not None
        },
    )


def _group(name: str, names: Mapping[str, str], table: Mapping[str, Any]) -> Group | None:
    scores = [_score(task, counted) for task, counted in mappings(table.get("tasks"))]
    tasks = [score for score in scores if score is not None]
    total = _score(tasks[0].task if len(tasks) == 1 else "all tasks", table.get("all"))
    if total is None:
        return None
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
        mean_return=number(counted["mean_return"]) if "mean_return" in counted else None,
    )


def _problems(names: Mapping[str, str], listed: Any) -> list[str]:
    """Lines for people; episodes without a result are neither successes nor failures."""
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
            caption=f"{names.get(str(row.get('group')), row.get('group', ''))} · "
            f"{row.get('task', '')} · seed {row.get('seed', '?')}"
            + (f" · instruction “{row['instruction']}”" if row.get("instruction") else ""),
            success=bool(row.get("success")),
            group=str(row.get("group", "")),
            task=str(row.get("task", "")),
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
        rows["in real time"] = (
            f"{number(live.get('missed_share')):.1%} of {live.get('ticks')} ticks without a target "
            f"of the policy; stopped by safety: {stopped or 'none'}"
        )
    tested = tables.get("instruction_test", {})
    if tested:
        rows["right against wrong instruction"] = (
            f"{tested.get('pairs')} pairs, exact McNemar test: "
            f"p = {number(tested.get('p_different')):.2g}, {tested.get('verdict', '')}"
        )
    if "policy_ms" in timing:
        rows["policy call"] = f"{number(timing['policy_ms']):.1f} ms on average"
    return {**_provenance(tables.get("provenance", {})), **rows, **tables.get("settings", {})}


def _provenance(table: Mapping[str, Any]) -> dict[str, Any]:
    """Rows on where and with what an evaluation ran."""
    versions = _versions(table)
    return {
        "machine": table.get("machine"),
        "versions": ", ".join(f"{name} {version}" for name, version in versions.items()),
    }


def _made(table: Mapping[str, Any]) -> str:
    """Date, commit and the most important versions of an evaluation, as a line."""
    date = str(table.get("date") or "").replace("T", " ").replace("+00:00", " UTC")
    commit, mark, changes = str(table.get("commit") or "").partition("+")
    named = [
        f"{name} {version}"
        for name, version in _versions(table).items()
        if any(part in name for part in NAMED_VERSIONS)
    ]
    parts = [f"evaluated {date}"] if date else []
    parts += [f"commit {commit[:12]}{mark}{changes}"] if commit else []
    return " · ".join([*parts, *([", ".join(named)] if named else [])])


def _versions(table: Mapping[str, Any]) -> Mapping[str, Any]:
    return dict(mappings({"versions": table.get("versions")})).get("versions", {})
