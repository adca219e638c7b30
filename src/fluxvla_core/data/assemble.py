"""Assemble saved episodes into one LeRobot v3.0 dataset, and merge such datasets.

The result is a pure function of the episodes and their order: datasets that parallel processes
recorded merge to what one process would have written.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.data import lerobot
from fluxvla_core.data.columns import read_columns
from fluxvla_core.data.files import (
    arrow,
    check_absent,
    parquet,
    read_table,
    staging_folder,
    write_metadata,
)
from fluxvla_core.data.metadata import Metadata, read_metadata
from fluxvla_core.data.statistics import (
    Stats,
    as_lists,
    column_statistics,
    histogram_statistics,
)
from fluxvla_core.data.video_encode import CODECS, Clip, join_clips
from fluxvla_core.errors import DataError
from fluxvla_core.spec import EmbodimentSpec, check_match

Array = npt.NDArray[Any]
MEGABYTE = 1024 * 1024


@dataclass(frozen=True)
class DatasetSettings:
    """Settings common to all episodes of a dataset; ``embodiment`` has the images' sizes."""

    fps: float
    embodiment: EmbodimentSpec
    video_codec: str
    robot_type: str
    data_file_mb: float = lerobot.DATA_FILE_MB
    video_file_mb: float = lerobot.VIDEO_FILE_MB


@dataclass(frozen=True)
class Episode:
    """One recorded episode.

    Args:
        task: the instruction.
        key: its place among episodes that other processes recorded, or None.
        state, action: ``(n, D)`` float32.
        clips: image feature -> its ``n`` frames.
        histograms: image feature -> ``(3, 256)`` pixel counts over all its frames.
    """

    task: str
    key: int | None
    state: Array
    action: Array
    clips: Mapping[str, Clip]
    histograms: Mapping[str, npt.NDArray[np.int64]]

    def __len__(self) -> int:
        return len(self.state)


def assemble(episodes: Sequence[Episode], out: Path, settings: DatasetSettings) -> None:
    """Write the dataset into the empty folder ``out``; ``meta/info.json`` comes last."""
    features = lerobot.describe_features(
        settings.embodiment, settings.fps, CODECS[settings.video_codec].stream
    )
    tasks = {task: i for i, task in enumerate(dict.fromkeys(e.task for e in episodes))}
    columns = [_columns(e, i, tasks[e.task], settings.fps) for i, e in enumerate(episodes)]
    starts = np.cumsum([0, *map(len, episodes)])
    for column, start in zip(columns, starts, strict=False):
        column["index"] = column["frame_index"] + start
    rows = [
        episode_row(i, [episode.task], starts[i], starts[i + 1])
        for i, episode in enumerate(episodes)
    ]
    _write_data(columns, rows, out, features, settings)
    for key in (k for k, f in features.items() if f["dtype"] == "video"):
        clips = [e.clips[key] for e in episodes]
        groups = split_by_size([clip.size for clip in clips], settings.video_file_mb * MEGABYTE)
        write_videos(key, clips, groups, rows, out, settings.fps)
    write_meta(out, rows, list(tasks), columns, [e.histograms for e in episodes])
    _write_extras(episodes, out)
    write_metadata(out / lerobot.EMBODIMENT, settings.embodiment.to_dict())
    write_metadata(
        out / lerobot.INFO,
        {
            "codebase_version": lerobot.VERSION,
            "robot_type": settings.robot_type,
            "total_episodes": len(episodes),
            "total_frames": int(starts[-1]),
            "total_tasks": len(tasks),
            "chunks_size": lerobot.CHUNK_FILES,
            "data_files_size_in_mb": lerobot.number(settings.data_file_mb),
            "video_files_size_in_mb": lerobot.number(settings.video_file_mb),
            "fps": lerobot.number(settings.fps),
            "splits": {"train": f"0:{len(episodes)}"},
            "data_path": lerobot.DATA,
            "video_path": lerobot.VIDEO,
            "features": features,
        },
    )


def episode_row(index: int, tasks: list[str], start: int, end: int) -> dict[str, Any]:
    """An episode's row in the episode table; it has the dataset's rows ``start`` to ``end``."""
    return {
        "episode_index": index,
        "tasks": tasks,
        "length": int(end - start),
        "dataset_from_index": int(start),
        "dataset_to_index": int(end),
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
    }


def make_path(out: Path, pattern: str, number: int, key: str = "") -> tuple[Path, dict[str, int]]:
    """Path of the ``number``-th file of a kind, its folder made, and the numbers in the path."""
    chunk, file = divmod(number, lerobot.CHUNK_FILES)
    numbers = {"chunk_index": chunk, "file_index": file}
    path = out / pattern.format(video_key=key, **numbers)
    path.parent.mkdir(parents=True, exist_ok=True)
    return path, numbers


def _columns(episode: Episode, index: int, task: int, fps: float) -> dict[str, Array]:
    """An episode's rows by feature; ``index`` still counts within the episode."""
    frames = np.arange(len(episode), dtype=np.int64)
    return {
        lerobot.STATE: episode.state,
        lerobot.ACTION: episode.action,
        "timestamp": (frames / fps).astype(np.float32),
        "frame_index": frames,
        "episode_index": np.full(len(frames), index, np.int64),
        "index": frames,
        "task_index": np.full(len(frames), task, np.int64),
    }


def _write_data(
    columns: Sequence[Mapping[str, Array]],
    rows: Sequence[dict[str, Any]],
    out: Path,
    features: Mapping[str, Mapping[str, Any]],
    settings: DatasetSettings,
) -> None:
    pa = arrow()
    pq = parquet()

    def column(array: Array) -> Any:
        flat = pa.array(array.ravel())
        return pa.FixedSizeListArray.from_arrays(flat, array.shape[1]) if array.ndim == 2 else flat

    metadata = {"huggingface": lerobot.datasets_schema(features)}
    tables = [pa.table({k: column(a) for k, a in rows_of.items()}) for rows_of in columns]
    groups = split_by_size([t.nbytes for t in tables], settings.data_file_mb * MEGABYTE)
    for number, group in enumerate(groups):
        path, numbers = make_path(out, lerobot.DATA, number)
        with pq.ParquetWriter(path, tables[0].schema.with_metadata(metadata)) as writer:
            for i in group:
                # One row group an episode lets a reader take single episodes.
                writer.write_table(tables[i].replace_schema_metadata(metadata))
                rows[i].update({f"data/{name}": value for name, value in numbers.items()})


def write_videos(
    key: str,
    clips: Sequence[Clip],
    groups: Sequence[Sequence[int]],
    rows: Sequence[dict[str, Any]],
    out: Path,
    fps: float,
) -> None:
    """Join each group of clips into a file, and set in ``rows`` where each of them is."""
    for number, group in enumerate(groups):
        path, numbers = make_path(out, lerobot.VIDEO, number, key)
        join_clips([clips[i] for i in group], path, fps)
        done = 0
        for i in group:
            end = done + clips[i].frames
            place = {**numbers, "from_timestamp": done / fps, "to_timestamp": end / fps}
            rows[i].update({f"videos/{key}/{name}": value for name, value in place.items()})
            done = end


def split_by_size(sizes: Sequence[float], limit: float) -> list[list[int]]:
    """Group consecutive items to at most ``limit`` each; a larger one is a group of its own."""
    groups: list[list[int]] = []
    filled = 0.0
    for i, size in enumerate(sizes):
        if not groups or filled + size > limit:
            groups.append([])
            filled = 0.0
        groups[-1].append(i)
        filled += size
    return groups


def write_meta(
    out: Path,
    rows: Sequence[dict[str, Any]],
    tasks: Sequence[str],
    columns: Sequence[Mapping[str, Array]],
    histograms: Sequence[Mapping[str, npt.NDArray[np.int64]]],
) -> None:
    """Write the tables of episodes and of tasks, and the statistics.

    Args:
        rows: of the episode table; each gets its episode's statistics.
        tasks: by ``task_index``.
        columns: of each episode, feature -> ``(n,)`` or ``(n, D)``.
        histograms: of each episode, camera -> ``(3, 256)`` pixel counts.
    """
    pa = arrow()
    pq = parquet()

    for row, values, counts in zip(rows, columns, histograms, strict=True):
        for key, entry in _statistics(counts, values).items():
            row.update({f"stats/{key}/{name}": value for name, value in as_lists(entry).items()})
    path, _ = make_path(out, lerobot.EPISODES, 0)
    # Integers and lists of one episode have the types of all: the rows are alike.
    pq.write_table(pa.Table.from_pylist(list(rows)), path)
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": list(tasks)})
    pq.write_table(
        table.replace_schema_metadata({"pandas": lerobot.pandas_schema()}), out / lerobot.TASKS
    )
    whole = {name: np.concatenate([c[name] for c in columns]) for name in columns[0]}
    totals = {key: np.sum([h[key] for h in histograms], axis=0) for key in histograms[0]}
    stats = _statistics(totals, whole)
    write_metadata(out / lerobot.STATS, {key: as_lists(entry) for key, entry in stats.items()})


def _statistics(
    histograms: Mapping[str, npt.NDArray[np.int64]], columns: Mapping[str, Array]
) -> dict[str, Stats]:
    """Statistics of each feature: cameras by pixel counts, columns ``(n, …)`` by rows."""
    frames = len(columns["index"])
    stats = {key: histogram_statistics(h, frames) for key, h in histograms.items()}
    for key, values in columns.items():
        stats[key] = column_statistics(values.reshape(frames, -1))
        if values.dtype == np.int64:
            for name in ("min", "max"):
                stats[key][name] = stats[key][name].astype(np.int64)
    return stats


def _write_extras(episodes: Sequence[Episode], out: Path) -> None:
    pa = arrow()
    pq = parquet()

    extras: dict[str, Any] = {"key": pa.array([e.key for e in episodes], pa.int64())}
    for name in episodes[0].histograms:
        counts = np.concatenate([e.histograms[name].ravel() for e in episodes])
        extras[f"histogram/{name}"] = pa.FixedSizeListArray.from_arrays(pa.array(counts), 768)
        # Of the clip as it was encoded: merging then splits files where recording did.
        extras[f"bytes/{name}"] = pa.array([e.clips[name].size for e in episodes], pa.int64())
    pq.write_table(pa.table(extras), out / lerobot.EXTRAS)


def merge_datasets(roots: Sequence[str | Path], out: str | Path) -> Path:
    """Merge datasets that :class:`LeRobotWriter` wrote; returns ``out``.

    Episodes come in the order of the keys that ``save_episode`` was given, so the result does not
    depend on how they were shared out among processes; without keys, in the order of ``roots``.
    Videos are copied, not encoded again. The sources stay as they are.

    Raises:
        DataError: a source is damaged, was written by another program, or differs in fps, codec
            or cameras; a key occurs twice; ``out`` exists.
        SpecMismatch: the sources were recorded with different robots.
        RunFailed: the disk is full.
    """
    target = Path(out)
    check_absent(target)
    if not roots:
        raise DataError("merge_datasets: no datasets were given")
    metas = [read_metadata(Path(root)) for root in roots]
    settings = _settings_of(metas[0])
    for meta in metas[1:]:
        _check_same_settings(settings, metas[0], meta)
    episodes = _sorted([episode for meta in metas for episode in _episodes_of(meta)])
    safe = "the datasets that were to be merged are as they were"
    with staging_folder(target, safe, "make room and merge again") as staging:
        assemble(episodes, staging, settings)
    return target


def _settings_of(meta: Metadata) -> DatasetSettings:
    if meta.embodiment is None or not (meta.root / lerobot.EXTRAS).is_file():
        raise DataError(
            f"{meta.root}: only datasets that LeRobotWriter wrote can be merged",
            cause=f"{lerobot.EMBODIMENT} or {lerobot.EXTRAS} is missing: another program wrote it",
        )
    try:
        streams = {str(meta.features[k]["info"]["video.codec"]) for k in meta.cameras}
        kept = [meta.info[k] for k in ("data_files_size_in_mb", "video_files_size_in_mb")]
        robot = meta.info["robot_type"]
    except (KeyError, TypeError) as error:
        raise DataError(f"{meta.root}: {lerobot.INFO} does not say {error}") from error
    codec = next((name for name, c in CODECS.items() if streams <= {c.stream}), None)
    if codec is None:
        raise DataError(f"{meta.root}: video codecs {sorted(streams)} cannot be merged")
    return DatasetSettings(meta.fps, meta.embodiment, codec, robot, *kept)


def _check_same_settings(first: DatasetSettings, one: Metadata, other: Metadata) -> None:
    second = _settings_of(other)
    check_match(first.embodiment, second.embodiment, str(one.root), str(other.root))
    for what, left, right in (
        ("fps", first.fps, second.fps),
        ("video codec", first.video_codec, second.video_codec),
        ("cameras", first.embodiment.cameras, second.embodiment.cameras),
    ):
        if left != right:
            raise DataError(
                f"{one.root} and {other.root} cannot be merged: {what}: {left} / {right}"
            )


def _episodes_of(meta: Metadata) -> list[Episode]:
    columns = read_columns(meta, [lerobot.STATE, lerobot.ACTION])
    names = [f"{kind}/{camera}" for kind in ("histogram", "bytes") for camera in meta.cameras]
    extras = read_table(meta.root / lerobot.EXTRAS, ["key", *names], len(meta.episodes))
    keys = extras["key"].to_pylist()
    histograms = {
        camera: extras[f"histogram/{camera}"].combine_chunks().flatten().to_numpy()
        for camera in meta.cameras
    }
    sizes = {camera: extras[f"bytes/{camera}"].to_pylist() for camera in meta.cameras}
    table = meta.episodes
    found = []
    for i in range(len(table)):
        rows = slice(table.first_row[i], table.end_row[i])
        found.append(
            Episode(
                meta.tasks[columns["task_index"][rows.start]],
                keys[i],
                columns[lerobot.STATE][rows],
                columns[lerobot.ACTION][rows],
                {camera: _clip(meta, camera, i, sizes[camera][i]) for camera in meta.cameras},
                {
                    camera: counts.reshape(-1, 3, 256)[i].astype(np.int64)
                    for camera, counts in histograms.items()
                },
            )
        )
    return found


def _clip(meta: Metadata, camera: str, episode: int, size: int) -> Clip:
    places = meta.episodes.videos[camera]
    path = meta.video_file(camera, places.files[episode])
    return Clip(path, int(meta.episodes.lengths[episode]), size, float(places.starts[episode]))


def _sorted(episodes: list[Episode]) -> list[Episode]:
    keys = [episode.key for episode in episodes if episode.key is not None]
    if not keys:
        return episodes
    if len(keys) != len(episodes):
        raise DataError(
            f"merge_datasets: {len(keys)} of {len(episodes)} episodes have a key",
            cause="save_episode(key=…) was called with a key for some episodes only",
        )
    twice = sorted({key for key in keys if keys.count(key) > 1})
    if twice:
        raise DataError(
            f"merge_datasets: {len(twice)} keys occur twice, for example {twice[0]}",
            cause="two processes recorded the same seeds",
        )
    return sorted(episodes, key=lambda episode: episode.key or 0)
