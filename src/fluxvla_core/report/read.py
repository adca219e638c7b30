"""From the files of a work dir to the facts of a report. Whatever is missing stays empty."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fluxvla_core.report.episodes import read_episodes
from fluxvla_core.report.facts import Facts, Stage, Training
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
    """What the metadata of the training data say, if the data are where the config says."""
    loader = dict(mappings(config)).get("train_dataloader", {})
    root = dict(mappings(loader)).get("dataset", {}).get("data_root_path")
    if not isinstance(root, str):
        return {}
    info = reader.mapping(Path(root) / "meta" / "info.json")
    return {"path": root, **info} if info else {}
