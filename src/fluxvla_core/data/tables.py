"""Read the tables below ``meta/``: episodes and tasks, in versions 2.0, 2.1 and 3.0.

Version 3.0 keeps them as parquet, version 2 as JSON lines:

    meta/episodes.jsonl     {"episode_index": 1, "tasks": ["…"], "length": 266}
    meta/tasks.jsonl        {"task_index": 1, "task": "…"}
    data/chunk-000/episode_000001.parquet
    videos/chunk-000/<feature>/episode_000001.mp4

Source: LeRobot 0.3 (codebase version v2.1); 2.0 keeps its statistics elsewhere, which are not read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.bounds import Count
from fluxvla_core.data import lerobot
from fluxvla_core.data.files import (
    arrow,
    read_json_lines,
    read_table,
    seconds,
    whole_numbers,
)
from fluxvla_core.errors import DataError

Ints = npt.NDArray[np.int64]
FileId = tuple[int, int]

_TASKS_V2 = "meta/tasks.jsonl"
_EPISODES_V2 = "meta/episodes.jsonl"


@dataclass(frozen=True)
class VideoPlaces:
    """Where each episode's video is: ``(chunk, file)`` and its start in seconds."""

    files: Sequence[FileId]
    starts: npt.NDArray[np.float64]


@dataclass(frozen=True)
class Episodes:
    """The episode table, one entry an episode; rows count over the whole dataset."""

    first_row: Ints
    end_row: Ints
    files: Sequence[FileId]
    videos: Mapping[str, VideoPlaces]

    def __len__(self) -> int:
        return len(self.first_row)

    @property
    def lengths(self) -> Ints:
        return self.end_row - self.first_row


def tasks_file(version: str) -> str:
    """The file of the instructions, by the dataset's version."""
    return lerobot.TASKS if version == lerobot.VERSION else _TASKS_V2


def read_tasks(root: Path, version: str) -> dict[int, Any]:
    """``task_index`` -> instruction; the order of the rows means nothing.

    Raises:
        DataError: the table is missing, damaged, or is not a table of tasks.
    """
    path = root / tasks_file(version)
    if version != lerobot.VERSION:
        return {row.task_index: row.task for row in read_json_lines(path, _TaskLine)}
    table = read_table(path)
    text = next((n for n in ("task", "__index_level_0__") if n in table.column_names), None)
    if text is None or "task_index" not in table.column_names:
        raise DataError(f"{path}: columns {table.column_names} hold no tasks")
    index = whole_numbers(table, "task_index", str(path)).tolist()
    return dict(zip(index, table[text].to_pylist(), strict=True))


def read_episodes(root: Path, info: Mapping[str, Any]) -> Episodes:
    """The episode table of the dataset whose ``meta/info.json`` is ``info``.

    Raises:
        DataError: it is missing, damaged, or skips or repeats an episode.
    """
    videos = [k for k, f in info["features"].items() if f["dtype"] == "video"]
    if info["codebase_version"] == lerobot.VERSION:
        return _read_episodes_v3(root, videos)
    return _read_episodes_v2(root, videos, info.get("chunks_size", lerobot.CHUNK_EPISODES))


@dataclass(frozen=True)
class _TaskLine:
    task_index: Count
    task: Any = None


@dataclass(frozen=True)
class _EpisodeLine:
    episode_index: Count
    length: Count


def _read_episodes_v2(root: Path, videos: Sequence[str], chunk: int) -> Episodes:
    """One data file and one video a camera for each episode; ``chunk`` episodes a folder."""
    lines = read_json_lines(root / _EPISODES_V2, _EpisodeLine)
    rows = [(line.episode_index, line.length) for line in lines]
    table = np.array(sorted(rows), np.int64).reshape(-1, 2)
    _check_numbering(root, table[:, 0])
    end = np.cumsum(table[:, 1])
    files = [(i // chunk, i) for i in range(len(rows))]
    starts = np.zeros(len(rows))
    return Episodes(end - table[:, 1], end, files, {k: VideoPlaces(files, starts) for k in videos})


def _read_episodes_v3(root: Path, videos: Sequence[str]) -> Episodes:
    pa = arrow()

    paths = sorted(root.glob("meta/episodes/*/*.parquet"))
    if not paths:
        raise DataError(f"{root}: meta/episodes holds no episode table")
    columns = [
        *("episode_index", "dataset_from_index", "dataset_to_index"),
        *("data/chunk_index", "data/file_index"),
        *(
            f"videos/{k}/{n}"
            for k in videos
            for n in ("chunk_index", "file_index", "from_timestamp")
        ),
    ]
    parts = [read_table(path, columns) for path in paths]
    try:
        table = pa.concat_tables(parts, promote_options="permissive").sort_by("episode_index")
    except pa.ArrowException as error:
        raise DataError(
            f"{root}: the files of meta/episodes are not of the same columns ({error})"
        ) from error
    where = f"{root}: meta/episodes"

    def whole(name: str) -> Ints:
        return whole_numbers(table, name, where)

    def files(prefix: str) -> list[FileId]:
        chunk, file = (whole(f"{prefix}/{n}_index").tolist() for n in ("chunk", "file"))
        return list(zip(chunk, file, strict=True))

    _check_numbering(root, whole("episode_index"))
    starts = {k: seconds(table, f"videos/{k}/from_timestamp", where) for k in videos}
    return Episodes(
        whole("dataset_from_index"),
        whole("dataset_to_index"),
        files("data"),
        {k: VideoPlaces(files(f"videos/{k}"), starts[k]) for k in videos},
    )


def _check_numbering(root: Path, numbers: Ints) -> None:
    """Refuse an episode table (sorted) that skips or repeats an episode."""
    if not np.array_equal(numbers, np.arange(len(numbers))):
        raise DataError(f"{root}: the episode table does not number its episodes 0, 1, 2, …")
