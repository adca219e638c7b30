"""Saved episodes to one dataset of v3.0. A pure function of the episodes and their order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.data import lerobot_v3 as v3
from fluxvla_core.data.encode import CODECS, Clip, join_clips
from fluxvla_core.data.files import write_json
from fluxvla_core.data.optional import arrow, parquet
from fluxvla_core.data.statistics import (
    Stats,
    as_lists,
    column_statistics,
    histogram_statistics,
)
from fluxvla_core.spec.embodiment import EmbodimentSpec

Array = npt.NDArray[Any]
MEGABYTE = 1024 * 1024


@dataclass(frozen=True)
class Recording:
    """What all episodes of a dataset share. ``embodiment`` has the recorded pictures' sizes."""

    fps: float
    embodiment: EmbodimentSpec
    video_codec: str
    robot_type: str
    data_file_mb: float = v3.DATA_FILE_MB
    video_file_mb: float = v3.VIDEO_FILE_MB


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


def assemble(episodes: Sequence[Episode], out: Path, recording: Recording) -> None:
    """Write the dataset into the empty folder ``out``; ``meta/info.json`` comes last."""
    features = v3.describe_features(
        recording.embodiment, recording.fps, CODECS[recording.video_codec].stream
    )
    tasks = {task: i for i, task in enumerate(dict.fromkeys(e.task for e in episodes))}
    columns = [_columns(e, i, tasks[e.task], recording.fps) for i, e in enumerate(episodes)]
    starts = np.cumsum([0, *map(len, episodes)])
    for column, start in zip(columns, starts, strict=False):
        column["index"] = column["frame_index"] + start
    rows: list[dict[str, Any]] = [
        {
            "episode_index": i,
            "tasks": [episode.task],
            "length": len(episode),
            "dataset_from_index": int(starts[i]),
            "dataset_to_index": int(starts[i + 1]),
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        for i, episode in enumerate(episodes)
    ]
    _write_data(columns, rows, out, features, recording)
    for key in (k for k, f in features.items() if f["dtype"] == "video"):
        clips = [e.clips[key] for e in episodes]
        groups = split_by_size([clip.size for clip in clips], recording.video_file_mb * MEGABYTE)
        write_videos(key, clips, groups, rows, out, recording.fps)
    for row, episode, column in zip(rows, episodes, columns, strict=True):
        row.update(flat_statistics(statistics_of(episode.histograms, column)))
    write_tables(rows, out, list(tasks))
    _write_extras(episodes, out)
    whole = {name: np.concatenate([c[name] for c in columns]) for name in columns[0]}
    totals = {
        k: np.sum([e.histograms[k] for e in episodes], axis=0) for k in episodes[0].histograms
    }
    write_json(out / v3.STATS, {k: as_lists(s) for k, s in statistics_of(totals, whole).items()})
    write_json(out / v3.EMBODIMENT, recording.embodiment.to_dict())
    write_json(
        out / v3.INFO,
        {
            "codebase_version": v3.VERSION,
            "robot_type": recording.robot_type,
            "total_episodes": len(episodes),
            "total_frames": int(starts[-1]),
            "total_tasks": len(tasks),
            "chunks_size": v3.CHUNK_FILES,
            "data_files_size_in_mb": v3.number(recording.data_file_mb),
            "video_files_size_in_mb": v3.number(recording.video_file_mb),
            "fps": v3.number(recording.fps),
            "splits": {"train": f"0:{len(episodes)}"},
            "data_path": v3.DATA,
            "video_path": v3.VIDEO,
            "features": features,
        },
    )


def _columns(episode: Episode, index: int, task: int, fps: float) -> dict[str, Array]:
    """The episode's rows by feature; ``index`` counts within the episode still."""
    frames = np.arange(len(episode), dtype=np.int64)
    return {
        v3.STATE: episode.state,
        v3.ACTION: episode.action,
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
    recording: Recording,
) -> None:
    pa = arrow()
    pq = parquet()

    def column(array: Array) -> Any:
        flat = pa.array(array.ravel())
        return pa.FixedSizeListArray.from_arrays(flat, array.shape[1]) if array.ndim == 2 else flat

    metadata = {"huggingface": v3.datasets_schema(features)}
    tables = [pa.table({k: column(a) for k, a in rows_of.items()}) for rows_of in columns]
    groups = split_by_size([t.nbytes for t in tables], recording.data_file_mb * MEGABYTE)
    for number, group in enumerate(groups):
        chunk, file = v3.file_of(number)
        path = out / v3.DATA.format(chunk_index=chunk, file_index=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        with pq.ParquetWriter(path, tables[0].schema.with_metadata(metadata)) as writer:
            for i in group:
                # One row group an episode lets a reader take single episodes.
                writer.write_table(tables[i].replace_schema_metadata(metadata))
                rows[i].update({"data/chunk_index": chunk, "data/file_index": file})


def write_videos(
    key: str,
    clips: Sequence[Clip],
    groups: Sequence[Sequence[int]],
    rows: Sequence[dict[str, Any]],
    out: Path,
    fps: float,
) -> None:
    """Join each group of clips into a file, and note in ``rows`` where each of them is."""
    for number, group in enumerate(groups):
        chunk, file = v3.file_of(number)
        path = out / v3.VIDEO.format(video_key=key, chunk_index=chunk, file_index=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        join_clips([clips[i] for i in group], path, fps)
        done = 0
        for i in group:
            end = done + clips[i].frames
            rows[i].update(
                {
                    f"videos/{key}/chunk_index": chunk,
                    f"videos/{key}/file_index": file,
                    f"videos/{key}/from_timestamp": done / fps,
                    f"videos/{key}/to_timestamp": end / fps,
                }
            )
            done = end


def split_by_size(sizes: Sequence[float], limit: float) -> list[list[int]]:
    """Consecutive positions in groups of at most ``limit``; a larger one is a group of its own."""
    groups: list[list[int]] = []
    filled = 0.0
    for i, size in enumerate(sizes):
        if not groups or filled + size > limit:
            groups.append([])
            filled = 0.0
        groups[-1].append(i)
        filled += size
    return groups


def statistics_of(
    histograms: Mapping[str, npt.NDArray[np.int64]], columns: Mapping[str, Array]
) -> dict[str, Stats]:
    """Statistics of each feature: cameras by their pixel counts, columns ``(n, …)`` by rows."""
    frames = len(columns["index"])
    stats = {key: histogram_statistics(h, frames) for key, h in histograms.items()}
    for key, values in columns.items():
        stats[key] = column_statistics(values.reshape(frames, -1))
        if values.dtype == np.int64:
            for name in ("min", "max"):
                stats[key][name] = stats[key][name].astype(np.int64)
    return stats


def flat_statistics(stats: Mapping[str, Stats]) -> dict[str, Any]:
    """One episode's statistics as its row of the episode table has them."""
    return {
        f"stats/{key}/{name}": value
        for key, entry in stats.items()
        for name, value in as_lists(entry).items()
    }


def write_tables(rows: Sequence[dict[str, Any]], out: Path, tasks: Sequence[str]) -> None:
    """The tables of episodes and of instructions, these by their ``task_index``."""
    pa = arrow()
    pq = parquet()

    path = out / v3.EPISODES.format(chunk_index=0, file_index=0)
    path.parent.mkdir(parents=True, exist_ok=True)
    # Integers and lists of one episode have the types of all: the rows are alike.
    pq.write_table(pa.Table.from_pylist(list(rows)), path)
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": list(tasks)})
    pq.write_table(table.replace_schema_metadata({"pandas": v3.pandas_schema()}), out / v3.TASKS)


def _write_extras(episodes: Sequence[Episode], out: Path) -> None:
    pa = arrow()
    pq = parquet()

    extras: dict[str, Any] = {"key": pa.array([e.key for e in episodes], pa.int64())}
    for name in episodes[0].histograms:
        counts = np.concatenate([e.histograms[name].ravel() for e in episodes])
        extras[f"histogram/{name}"] = pa.FixedSizeListArray.from_arrays(pa.array(counts), 768)
        # Of the clip as it was encoded: merging then splits files where recording did.
        extras[f"bytes/{name}"] = pa.array([e.clips[name].size for e in episodes], pa.int64())
    pq.write_table(pa.table(extras), out / v3.EXTRAS)
