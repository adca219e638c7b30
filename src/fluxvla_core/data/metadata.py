"""Read and check a dataset's ``meta/``, in versions 2.0, 2.1 and 3.0; no rows and no frames.

Version 3.0 keeps the tables of episodes and tasks as parquet, version 2 as JSON lines:

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
    read_json,
    read_json_lines,
    read_table,
    seconds,
    staging_of,
    whole_numbers,
)
from fluxvla_core.data.lerobot import check_info, fill
from fluxvla_core.errors import DataError, nearest
from fluxvla_core.spec import EmbodimentSpec

Ints = npt.NDArray[np.int64]
FileId = tuple[int, int]

_TASKS_V2 = "meta/tasks.jsonl"
_EPISODES_V2 = "meta/episodes.jsonl"
_MOST_TASKS = 1_000_000
"""The largest dataset that is published, DROID, has some 50,000 instructions."""
VERSIONS = ("v2.0", "v2.1", lerobot.VERSION)


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


@dataclass(frozen=True)
class Metadata:
    """A dataset's ``meta/``.

    ``tasks[i]`` is the instruction with ``task_index`` i; ``embodiment`` the robot that FluxVLA
    recorded it with, None for datasets of other programs.
    """

    root: Path
    info: Mapping[str, Any]
    tasks: tuple[str, ...]
    episodes: Episodes
    embodiment: EmbodimentSpec | None

    @property
    def version(self) -> str:
        """``v2.0``, ``v2.1`` or ``v3.0``."""
        return str(self.info["codebase_version"])

    @property
    def tasks_file(self) -> str:
        """The file of the instructions, below ``root``."""
        return _tasks_file(self.version)

    @property
    def fps(self) -> float:
        return float(self.info["fps"])

    @property
    def features(self) -> Mapping[str, Mapping[str, Any]]:
        features: Mapping[str, Mapping[str, Any]] = self.info["features"]
        return features

    @property
    def cameras(self) -> list[str]:
        """The features that are images or video."""
        return [k for k, f in self.features.items() if f["dtype"] in ("video", "image")]

    @property
    def vectors(self) -> list[str]:
        """The features that are one vector of float32 or float64 a frame."""
        return [
            k
            for k, f in self.features.items()
            if f["dtype"].startswith("float")
            and len(f["shape"]) == 1
            and k not in lerobot.INDEX_FEATURES
        ]

    def data_file(self, file: FileId) -> Path:
        return self.root / fill(self.info["data_path"], _numbers(file))

    def video_file(self, key: str, file: FileId) -> Path:
        return self.root / fill(self.info["video_path"], _numbers(file), key)

    def camera(self, name: str) -> str:
        """The feature of the camera ``name``, which is a feature or a camera's short name.

        Raises:
            DataError: there is none, or its images are not in colour.
        """
        for key in (name, lerobot.image_feature(name)):
            if key in self.features:
                dtype = self.features[key]["dtype"]
                if key not in self.cameras:
                    raise DataError(
                        f"{self.root}: {key!r} is stored as {dtype!r}, it is not a camera"
                    )
                shape = tuple(self.features[key]["shape"])
                if dtype == "image" and 3 not in (shape[0], shape[-1]):
                    raise DataError(f"{self.root}: {key!r} is of shape {shape}, not in colour")
                return key
        raise DataError(f"{self.root}: there is no camera {name!r}{self.hint(name, self.cameras)}")

    def image_size(self, key: str) -> tuple[int, int]:
        """Height and width of a camera's images; some datasets list the channels first."""
        first, middle, last = map(int, self.features[key]["shape"])
        return (middle, last) if first == 3 and last != 3 else (first, middle)

    def vector(self, name: str) -> int:
        """The width of the vector feature ``name``.

        Raises:
            DataError: there is none, or it is not a vector of numbers.
        """
        numbers = [
            k
            for k, f in self.features.items()
            if f["dtype"].startswith("float") and k not in lerobot.INDEX_FEATURES
        ]
        if name not in self.features:
            raise DataError(f"{self.root}: there is no feature {name!r}{self.hint(name, numbers)}")
        feature = self.features[name]
        if name not in numbers or len(feature["shape"]) != 1:
            raise DataError(
                f"{self.root}: feature {name!r} is {feature['dtype']} of shape "
                f"{tuple(feature['shape'])}, not a vector of float32 or float64"
            )
        return int(feature["shape"][0])

    def names(self, key: str) -> list[str]:
        """The names of a vector's entries; in older datasets they are a table of lists.

        Empty if there are none, or not one for each entry.
        """
        names = self.features[key].get("names")
        if isinstance(names, Mapping):
            names = [n for part in names.values() if isinstance(part, list) for n in part]
        fits = isinstance(names, list) and len(names) == self.vector(key)
        return [str(n) for n in names or ()] if fits else []

    def hint(self, name: str, known: Sequence[str]) -> str:
        """The end of an error message: ``; did you mean …? there are …``."""
        short = {lerobot.camera_name(k): k for k in known}
        near = nearest(lerobot.camera_name(name), short)
        mean = f"; did you mean {short[near]!r}?" if near else ";"
        return f"{mean} there are {', '.join(known) or 'none'}"


def read_metadata(root: Path) -> Metadata:
    """Read ``meta/`` below ``root``.

    Raises:
        DataError: no such folder, not a dataset, of another version, empty, or damaged.
        SpecMismatch: the file of its robot is not an embodiment.
    """
    info = _read_info(root)
    episodes = _read_episodes(root, info)
    tasks = _read_tasks(root, info["codebase_version"])
    frames = int(episodes.lengths.sum())
    for what, stated, found in (
        ("episodes", info["total_episodes"], len(episodes)),
        ("frames", info["total_frames"], frames),
    ):
        if stated != found:
            raise DataError(
                f"{root}: {lerobot.INFO} states {stated} {what}, the episode table lists {found}",
                cause="a part of the dataset is missing, or its writer was stopped",
            )
    empty = np.flatnonzero(episodes.lengths < 1)
    if len(empty):
        raise DataError(
            f"{root}: episode {empty[0]} has {episodes.lengths[empty[0]]} frames",
            cause="it was never recorded, or the episode table was edited",
        )
    path = root / lerobot.EMBODIMENT
    embodiment = EmbodimentSpec.from_dict(read_json(path)) if path.is_file() else None
    return Metadata(root, info, tasks, episodes, embodiment)


def _read_info(root: Path) -> dict[str, Any]:
    if not root.exists():
        raise DataError(
            f"{root}: there is no dataset here: the folder does not exist",
            cause=_unfinished(root),
            next="check the path, which is relative to the folder that the command runs in; in a "
            "config it is data_root_path: --set train_dataloader.dataset.data_root_path=DIR",
        )
    path = root / lerobot.INFO
    if not path.is_file():
        what = "is a file" if root.is_file() else f"has no {lerobot.INFO}"
        raise DataError(
            f"{root}: this is not a LeRobot dataset: it {what}",
            cause=_inner_dataset(root),
        )
    info = read_json(path)
    version = info.get("codebase_version")
    if not isinstance(version, str) or version not in VERSIONS:
        raise DataError(
            f"{root}: LeRobot dataset of version {str(version)[:40]}, "
            f"{', '.join(VERSIONS[:-1])} and {VERSIONS[-1]} are what is read here",
            next="convert a copy with the LeRobot that reads it",
        )
    missing = sorted({"fps", "features", "data_path", "total_episodes", "total_frames"} - set(info))
    if missing:
        raise DataError(f"{path}: {', '.join(missing)} missing")
    check_info(info, str(path))
    videos = any(feature["dtype"] == "video" for feature in info["features"].values())
    if videos and not info.get("video_path"):
        raise DataError(f"{path}: video_path missing")
    if info["total_episodes"] == 0 or info["total_frames"] == 0:
        raise DataError(
            f"{root}: the dataset is empty: {info['total_episodes']} episodes, "
            f"{info['total_frames']} frames",
            cause="nothing was recorded into it yet",
        )
    return info


def _unfinished(root: Path) -> str | None:
    staging = staging_of(root)
    if staging.is_dir():
        return f"its recording was never finalized; what was saved is in {staging}"
    return None


def _inner_dataset(root: Path) -> str | None:
    inner = next(root.glob(f"*/{lerobot.INFO}"), None) if root.is_dir() else None
    return f"did you mean {inner.parent.parent}?" if inner else None


def _numbers(file: FileId) -> dict[str, int]:
    """The numbers that a path pattern may name; version 2 has other names for them."""
    chunk, number = file
    return {
        "chunk_index": chunk,
        "file_index": number,
        "episode_chunk": chunk,
        "episode_index": number,
    }


def _tasks_file(version: str) -> str:
    return lerobot.TASKS if version == lerobot.VERSION else _TASKS_V2


def _read_tasks(root: Path, version: str) -> tuple[str, ...]:
    """Instructions by ``task_index``, empty where there is none; rows may come in any order.

    Raises:
        DataError: the table is missing, damaged, or is not a table of tasks.
    """
    path = root / _tasks_file(version)
    if version == lerobot.VERSION:
        numbered = _tasks_v3(path)
    else:
        numbered = {row.task_index: row.task for row in read_json_lines(path, _TaskLine)}
    last = max(numbered, default=-1)
    if last >= _MOST_TASKS:
        raise DataError(
            f"{root}: task_index {last}, {_MOST_TASKS} instructions are the most that are read",
            cause="the table of tasks was damaged, or made by hand",
        )
    for index, text in numbered.items():
        if not isinstance(text, str):
            raise DataError(f"{root}: task_index {index} has no instruction, but {text!r}")
    return tuple(numbered.get(i, "") for i in range(last + 1))


def _tasks_v3(path: Path) -> dict[int, Any]:
    table = read_table(path)
    text = next((n for n in ("task", "__index_level_0__") if n in table.column_names), None)
    if text is None or "task_index" not in table.column_names:
        raise DataError(f"{path}: columns {table.column_names} hold no tasks")
    index = whole_numbers(table, "task_index", str(path)).tolist()
    return dict(zip(index, table[text].to_pylist(), strict=True))


def _read_episodes(root: Path, info: Mapping[str, Any]) -> Episodes:
    """The episode table of the dataset whose ``meta/info.json`` is ``info``.

    Raises:
        DataError: it is missing, damaged, or skips or repeats an episode.
    """
    videos = [k for k, f in info["features"].items() if f["dtype"] == "video"]
    if info["codebase_version"] == lerobot.VERSION:
        return _episodes_v3(root, videos)
    return _episodes_v2(root, videos, info.get("chunks_size", lerobot.CHUNK_EPISODES))


@dataclass(frozen=True)
class _TaskLine:
    task_index: Count
    task: Any = None


@dataclass(frozen=True)
class _EpisodeLine:
    episode_index: Count
    length: Count


def _episodes_v2(root: Path, videos: Sequence[str], chunk: int) -> Episodes:
    """One data file and one video a camera for each episode; ``chunk`` episodes a folder."""
    lines = read_json_lines(root / _EPISODES_V2, _EpisodeLine)
    rows = [(line.episode_index, line.length) for line in lines]
    table = np.array(sorted(rows), np.int64).reshape(-1, 2)
    _check_numbering(root, table[:, 0])
    end = np.cumsum(table[:, 1])
    files = [(i // chunk, i) for i in range(len(rows))]
    starts = np.zeros(len(rows))
    return Episodes(end - table[:, 1], end, files, {k: VideoPlaces(files, starts) for k in videos})


def _episodes_v3(root: Path, videos: Sequence[str]) -> Episodes:
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
