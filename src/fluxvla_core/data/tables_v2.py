"""The tables below ``meta/`` as versions 2.0 and 2.1 have them: JSON lines.

Source: LeRobot 0.3 (codebase version v2.1); 2.0 keeps its statistics elsewhere, which are not read.

    meta/episodes.jsonl     {"episode_index": 1, "tasks": ["…"], "length": 266}
    meta/tasks.jsonl        {"task_index": 1, "task": "…"}
    data/chunk-000/episode_000001.parquet
    videos/chunk-000/<feature>/episode_000001.mp4
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fluxvla_core.data.episodes import Episodes, VideoPlaces, check_numbering
from fluxvla_core.data.files import read_json_lines
from fluxvla_core.errors import DataError

TASKS = "meta/tasks.jsonl"
EPISODES = "meta/episodes.jsonl"
CHUNK_EPISODES = 1000


def read_tasks(root: Path) -> dict[int, Any]:
    """``task_index`` -> instruction; the order of the lines means nothing.

    Raises:
        DataError: the file is missing, damaged, or a line has no ``task_index``.
    """
    path = root / TASKS
    return {_whole(path, row, "task_index"): row.get("task") for row in read_json_lines(path)}


def read_episodes(root: Path, info: Mapping[str, Any]) -> Episodes:
    """The episode table: one data file and one video a camera for each episode.

    Raises:
        DataError: it is missing, damaged, or not numbered through.
    """
    path = root / EPISODES
    rows = [
        (_whole(path, row, "episode_index"), _whole(path, row, "length"))
        for row in read_json_lines(path)
    ]
    table = np.array(sorted(rows), np.int64).reshape(-1, 2)
    check_numbering(root, table[:, 0])
    end = np.cumsum(table[:, 1])
    size = int(info.get("chunks_size", CHUNK_EPISODES))
    files = [(i // size, i) for i in range(len(rows))]
    videos = [k for k, f in info["features"].items() if f["dtype"] == "video"]
    starts = np.zeros(len(rows))
    return Episodes(end - table[:, 1], end, files, {k: VideoPlaces(files, starts) for k in videos})


def _whole(path: Path, row: Mapping[str, Any], key: str) -> int:
    value = row.get(key)
    if not isinstance(value, int):
        raise DataError(f"{path}: {row} has no whole number {key!r}")
    return value
