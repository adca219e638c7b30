"""What a dataset says about itself: ``meta/`` of LeRobot v3.0, read and checked, no frames yet."""

from __future__ import annotations

import difflib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.data import lerobot_v3 as v3
from fluxvla_core.data.optional import arrow, parquet
from fluxvla_core.errors import DataError
from fluxvla_core.spec.embodiment import EmbodimentSpec

Ints = npt.NDArray[np.int64]
FileId = tuple[int, int]


@dataclass(frozen=True)
class VideoPlaces:
    """Where each episode's video is: ``(chunk_index, file_index)`` and its start in seconds."""

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
    """A dataset's ``meta/``. ``tasks[i]`` is the instruction with ``task_index`` i."""

    root: Path
    info: Mapping[str, Any]
    tasks: tuple[str, ...]
    episodes: Episodes
    embodiment: EmbodimentSpec | None

    @property
    def fps(self) -> float:
        return float(self.info["fps"])

    @property
    def features(self) -> Mapping[str, Mapping[str, Any]]:
        features: Mapping[str, Mapping[str, Any]] = self.info["features"]
        return features

    @property
    def cameras(self) -> list[str]:
        """Features that are pictures."""
        return [k for k, f in self.features.items() if f["dtype"] in ("video", "image")]

    def data_file(self, file: FileId) -> Path:
        pattern: str = self.info["data_path"]
        return self.root / pattern.format(chunk_index=file[0], file_index=file[1])

    def video_file(self, key: str, file: FileId) -> Path:
        pattern: str = self.info["video_path"]
        return self.root / pattern.format(video_key=key, chunk_index=file[0], file_index=file[1])

    def camera(self, name: str) -> str:
        """The feature that ``name`` (a feature, or a camera's short name) means.

        Raises:
            DataError: there is none, or it is not stored as video.
        """
        for key in (name, v3.image_feature(name)):
            if key in self.features:
                dtype = self.features[key]["dtype"]
                if dtype == "video":
                    return key
                raise DataError(
                    f"{self.root}: {key!r} is stored as {dtype!r}, only video is read",
                    next="convert it to a dataset with video" if dtype == "image" else None,
                )
        raise DataError(f"{self.root}: there is no camera {name!r}{self.hint(name, self.cameras)}")

    def vector(self, name: str) -> int:
        """The width of the vector feature ``name``.

        Raises:
            DataError: there is none, or it is no vector of numbers.
        """
        numbers = [
            k
            for k, f in self.features.items()
            if f["dtype"].startswith("float") and k not in v3.INDEX_FEATURES
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

    def hint(self, name: str, known: Sequence[str]) -> str:
        """``; did you mean …? there are …`` for a message."""
        short = {v3.camera_name(k): k for k in known}
        near = difflib.get_close_matches(v3.camera_name(name), short, 1)
        mean = f"; did you mean {short[near[0]]!r}?" if near else ";"
        return f"{mean} there are {', '.join(known) or 'none'}"


def read_metadata(root: Path) -> Metadata:
    """Read ``meta/`` below ``root``.

    Raises:
        DataError: no such folder, not a dataset, of another version, empty, or damaged.
    """
    info = _read_info(root)
    episodes = _read_episodes(root, info)
    tasks = _read_tasks(root)
    frames = int(episodes.lengths.sum())
    for what, stated, found in (
        ("episodes", info["total_episodes"], len(episodes)),
        ("frames", info["total_frames"], frames),
    ):
        if stated != found:
            raise DataError(
                f"{root}: {v3.INFO} states {stated} {what}, the episode table lists {found}",
                cause="a part of the dataset is missing, or its writer was stopped",
            )
    return Metadata(root, info, tasks, episodes, read_embodiment(root))


def read_embodiment(root: Path) -> EmbodimentSpec | None:
    """The robot that a dataset of ours was recorded with; None for others' datasets.

    Raises:
        DataError: the file is no JSON. SpecMismatch: it is no embodiment.
    """
    path = root / v3.EMBODIMENT
    return EmbodimentSpec.from_dict(read_json(path)) if path.is_file() else None


def _read_info(root: Path) -> dict[str, Any]:
    if not root.exists():
        raise DataError(
            f"{root}: there is no dataset here: the folder does not exist",
            cause=_unfinished(root),
            next="check data_root_path; it is relative to the folder that the command runs in",
        )
    path = root / v3.INFO
    if not path.is_file():
        what = "is a file" if root.is_file() else f"has no {v3.INFO}"
        raise DataError(
            f"{root}: this is no LeRobot dataset: it {what}",
            cause=_inner_dataset(root),
        )
    info = read_json(path)
    version = info.get("codebase_version")
    if not str(version).startswith(v3.VERSION):
        raise DataError(
            f"{root}: LeRobot dataset of version {version}, {v3.VERSION} is what is read here",
            next="convert a copy: python -m lerobot.datasets.v30.convert_dataset_v21_to_v30 "
            f"--repo-id=NAME --root={root}"
            if str(version).startswith("v2.")
            else None,
        )
    missing = sorted({"fps", "features", "data_path", "total_episodes", "total_frames"} - set(info))
    if missing:
        raise DataError(f"{path}: {', '.join(missing)} missing")
    if info["total_episodes"] == 0 or info["total_frames"] == 0:
        raise DataError(
            f"{root}: the dataset is empty: {info['total_episodes']} episodes, "
            f"{info['total_frames']} frames",
            cause="nothing was recorded into it yet",
        )
    return info


def _unfinished(root: Path) -> str | None:
    staging = root.with_name(f".{root.name}.writing")
    if staging.is_dir():
        return f"its recording was never finalized; what was saved is in {staging}"
    return None


def _inner_dataset(root: Path) -> str | None:
    inner = next(root.glob(f"*/{v3.INFO}"), None) if root.is_dir() else None
    return f"did you mean {inner.parent.parent}?" if inner else None


def _read_tasks(root: Path) -> tuple[str, ...]:
    table = read_table(root / v3.TASKS)
    text = next((n for n in ("task", "__index_level_0__") if n in table.column_names), None)
    if text is None or "task_index" not in table.column_names:
        raise DataError(f"{root / v3.TASKS}: columns {table.column_names} hold no tasks")
    found = dict(zip(table["task_index"].to_pylist(), table[text].to_pylist(), strict=True))
    return tuple(found.get(i, "") for i in range(max(found, default=-1) + 1))


def _read_episodes(root: Path, info: Mapping[str, Any]) -> Episodes:
    pa = arrow()

    paths = sorted(root.glob("meta/episodes/*/*.parquet"))
    if not paths:
        raise DataError(f"{root}: meta/episodes holds no episode table")
    videos = [k for k, f in info["features"].items() if f["dtype"] == "video"]
    columns = [
        *("episode_index", "dataset_from_index", "dataset_to_index"),
        *("data/chunk_index", "data/file_index"),
        *(
            f"videos/{k}/{n}"
            for k in videos
            for n in ("chunk_index", "file_index", "from_timestamp")
        ),
    ]
    table = pa.concat_tables([read_table(path, columns) for path in paths])
    table = table.sort_by("episode_index")
    index = table["episode_index"].to_numpy()
    if not np.array_equal(index, np.arange(len(index))):
        raise DataError(f"{root}: the episode table does not number its episodes 0, 1, 2, …")

    def files(prefix: str) -> list[FileId]:
        chunk, file = (table[f"{prefix}/{n}_index"].to_pylist() for n in ("chunk", "file"))
        return list(zip(chunk, file, strict=True))

    return Episodes(
        table["dataset_from_index"].to_numpy().astype(np.int64),
        table["dataset_to_index"].to_numpy().astype(np.int64),
        files("data"),
        {
            k: VideoPlaces(files(f"videos/{k}"), table[f"videos/{k}/from_timestamp"].to_numpy())
            for k in videos
        },
    )


def read_table(path: Path, columns: Sequence[str] | None = None) -> Any:
    """A parquet file as a pyarrow table.

    Raises:
        DataError: it is missing, damaged, or lacks a column.
    """
    pa = arrow()
    pq = parquet()

    if not path.is_file():
        raise DataError(f"{path}: the file is missing")
    try:
        with pq.ParquetFile(path) as file:
            lacking = sorted(set(columns or ()) - set(file.schema_arrow.names))
            if lacking:
                raise DataError(f"{path}: column {', '.join(map(repr, lacking))} is missing")
            return file.read(columns=list(columns) if columns else None, use_threads=False)
    except (pa.ArrowException, OSError) as error:
        raise DataError(
            f"{path}: cannot be read as parquet ({str(error).splitlines()[0]})",
            cause="the file is truncated, or its writer was stopped before its end",
            next="copy the file again from where it came from",
        ) from error


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object. Raises DataError if it cannot be read."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: cannot be read as JSON ({error})") from error
    if not isinstance(found, dict):
        raise DataError(f"{path}: holds a {type(found).__name__}, not a table")
    return found
