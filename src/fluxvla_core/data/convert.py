"""Convert LeRobot datasets of v2.0 and v2.1 to v3.0: ``fluxvla data convert``.

Rows, with the images in them, and video packets are copied unchanged. Statistics are recomputed
exactly: version 2 has no quantiles, and estimates those of images from samples. This decodes every
frame, and so checks that the dataset is complete.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.runner import Reporter, SilentReporter
from fluxvla_core.data import lerobot
from fluxvla_core.data.assemble import (
    MEGABYTE,
    episode_row,
    make_path,
    split_by_size,
    write_meta,
    write_videos,
)
from fluxvla_core.data.columns import has_width, read_columns
from fluxvla_core.data.files import arrow, parquet, read_table, staging_folder, write_metadata
from fluxvla_core.data.metadata import Metadata, read_metadata
from fluxvla_core.data.statistics import LEVELS, image_histogram
from fluxvla_core.data.video_decode import ImageColumn, Source, read_frames
from fluxvla_core.data.video_encode import Clip, whole_clip
from fluxvla_core.errors import DataError

Counts = npt.NDArray[np.int64]
Columns = dict[str, npt.NDArray[Any]]


def convert(root: str | Path, out: str | Path, reporter: Reporter | None = None) -> Path:
    """Write the dataset below ``root`` as version 3.0 to ``out``; returns ``out``.

    ``root`` is not changed. ``out`` appears in one step when it is complete.

    Raises:
        DataError: ``root`` is damaged, or of version 3.0 already; ``out`` exists.
        RunFailed: the disk is full.
    """
    reporter = reporter or SilentReporter()
    source, target = Path(root), Path(out)
    meta = read_metadata(source)
    if meta.version == lerobot.VERSION:
        raise DataError(f"{source}: is of version {lerobot.VERSION} already")
    checked = read_columns(meta, meta.vectors)
    with staging_folder(target, f"{source} is as it was", "make room and convert again") as staging:
        _write(meta, checked["task_index"], staging, reporter)
        made = read_metadata(staging)
        read_columns(made, made.vectors)
    return target


def _write(meta: Metadata, tasks: npt.NDArray[Any], out: Path, reporter: Reporter) -> None:
    episodes = meta.episodes
    rows: list[dict[str, Any]] = []
    for i, (start, end) in enumerate(zip(episodes.first_row, episodes.end_row, strict=True)):
        texts = dict.fromkeys(meta.tasks[t] for t in tasks[start:end])
        rows.append(episode_row(i, list(texts), start, end))
    columns = _copy_rows(meta, rows, out)
    histograms: list[dict[str, Counts]] = [{} for _ in rows]
    frames = int(episodes.lengths.sum())
    total = len(meta.cameras) * frames
    for part, key in enumerate(meta.cameras):
        clips, parameters = [], []
        for i, length in enumerate(map(int, episodes.lengths)):
            table = meta.data_file(episodes.files[i])
            source: Source = ImageColumn(table, key, meta.image_size(key))
            period = 1.0
            if key in episodes.videos:
                source = meta.video_file(key, episodes.videos[key].files[i])
                clip, kind = whole_clip(source, length, meta.fps)
                clips.append(clip)
                parameters.append(kind)
                period = 1 / meta.fps
            histograms[i][key] = _count_pixels(source, length, period)
            done = part * frames + int(episodes.end_row[i])
            reporter.progress("convert frames", done, total, camera=lerobot.camera_name(key))
        if clips:
            groups = _groups(clips, parameters)
            write_videos(key, clips, groups, rows, out, meta.fps)
    write_meta(out, rows, meta.tasks, columns, histograms)
    if (meta.root / lerobot.EMBODIMENT).is_file():
        shutil.copyfile(meta.root / lerobot.EMBODIMENT, out / lerobot.EMBODIMENT)
    gone = ("total_chunks", "total_videos")
    info = {
        **{key: value for key, value in meta.info.items() if key not in gone},
        "codebase_version": lerobot.VERSION,
        "total_tasks": len(meta.tasks),
        "chunks_size": lerobot.CHUNK_FILES,
        "data_files_size_in_mb": lerobot.DATA_FILE_MB,
        "video_files_size_in_mb": lerobot.VIDEO_FILE_MB,
        "data_path": lerobot.DATA,
        "video_path": lerobot.VIDEO if episodes.videos else None,
    }
    write_metadata(out / lerobot.INFO, info)


def _copy_rows(meta: Metadata, rows: Sequence[dict[str, Any]], out: Path) -> list[Columns]:
    """Write the data files; returns each episode's numbers, ``(n,)`` or ``(n, D)`` a column."""
    pa = arrow()
    pq = parquet()

    paths = [meta.data_file(file) for file in meta.episodes.files]
    sizes = [path.stat().st_size for path in paths]
    metadata = {"huggingface": lerobot.datasets_schema(meta.features)}
    names = [key for key, f in meta.features.items() if f["dtype"] != "video"]
    columns: list[Columns] = []
    schema: Any = None
    for number, group in enumerate(split_by_size(sizes, lerobot.DATA_FILE_MB * MEGABYTE)):
        path, numbers = make_path(out, lerobot.DATA, number)
        writer: Any = None
        for i in group:
            table = _rows(paths[i], names, rows[i]["dataset_from_index"])
            schema = schema or table.schema.with_metadata(metadata)
            try:
                table = table.cast(schema)
            except pa.ArrowException as error:
                raise DataError(
                    f"{paths[i]}: its columns are not of the types of {paths[0]} ({error})"
                ) from error
            writer = writer or pq.ParquetWriter(path, schema)
            writer.write_table(table)
            rows[i].update({f"data/{name}": value for name, value in numbers.items()})
            columns.append(_numbers(table))
        writer.close()
    # What has gaps in one episode has no statistics in any.
    known = [name for name in columns[0] if all(name in found for found in columns)]
    return [{name: found[name] for name in known} for found in columns]


def _rows(path: Path, names: Sequence[str], start: int) -> Any:
    """An episode's table, its ``index`` counting the dataset's rows from ``start`` on."""
    pa = arrow()

    table = read_table(path, names).select(names)
    index = pa.array(np.arange(start, start + table.num_rows))
    return table.set_column(table.schema.get_field_index("index"), "index", index)


def _numbers(table: Any) -> Columns:
    """Columns of numbers, or of equally long lists of numbers; the others have no statistics."""
    pa = arrow()

    found: Columns = {}
    for name in table.column_names:
        column = table[name].combine_chunks()
        lists = pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type)
        flat = column.flatten() if lists else column
        kind = flat.type
        number = (
            pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)
        )
        width = len(flat) // len(column)
        whole = not flat.null_count and len(flat) == len(column) * width
        if number and whole and (not lists or has_width(column, width)):
            values = flat.to_numpy(zero_copy_only=False)
            found[name] = values.reshape(len(column), -1) if lists else values
    return found


def _count_pixels(source: Source, frames: int, period: float) -> Counts:
    counts = np.zeros((3, LEVELS), np.int64)
    for image in read_frames(source, (i * period for i in range(frames))):
        counts += image_histogram(image)
    return counts


def _groups(clips: Sequence[Clip], parameters: Sequence[bytes]) -> list[list[int]]:
    """Consecutive clips that make a file: not too large, and all of one encoder's parameters."""
    groups: list[list[int]] = []
    for group in split_by_size([clip.size for clip in clips], lerobot.VIDEO_FILE_MB * MEGABYTE):
        for place, i in enumerate(group):
            if place == 0 or parameters[i] != parameters[i - 1]:
                groups.append([])
            groups[-1].append(i)
    return groups
