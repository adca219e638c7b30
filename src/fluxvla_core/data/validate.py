"""Check a dataset down to its last frame: ``fluxvla data validate``.

Opening a dataset checks its tables and the indices of its videos; this also decodes every frame,
and does not stop at the first damaged file.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.reporter import Reporter, SilentReporter
from fluxvla_core.data import lerobot
from fluxvla_core.data.columns import Track, check_tasks, make_track, read_columns
from fluxvla_core.data.files import read_json, read_table
from fluxvla_core.data.metadata import Metadata, read_metadata
from fluxvla_core.data.statistics import column_statistics
from fluxvla_core.data.video_decode import ExpectedVideo, check_video, open_source
from fluxvla_core.errors import DataError, FluxError

LISTED = 20
EVERY = 100
"""Frames between two reports of progress."""


def validate(root: Path, reporter: Reporter | None = None) -> list[str]:
    """Read all columns and decode all frames of the dataset below ``root``.

    Returns:
        Warnings: the dataset can be used, but somebody should know; ``reporter`` gets them, too.

    Raises:
        DataError: everything that is wrong, with the files' names.
    """
    reporter = reporter or SilentReporter()
    meta = read_metadata(root)
    columns = _read_columns(meta)
    frames = len(columns["timestamp"])
    reporter.info(
        f"{root}: LeRobot {meta.version}, {len(meta.episodes)} episodes, "
        f"{frames} frames at {meta.fps:g} Hz"
    )
    wrong = _wrong_times(meta, columns["timestamp"])
    try:
        check_tasks(meta, columns["task_index"])
    except DataError as error:
        wrong.append(str(error))
    damaged: set[Path] = set()

    def check(path: Path, stated: ExpectedVideo) -> None:
        try:
            check_video(path, stated)
        except DataError as error:
            wrong.append(str(error))
            damaged.add(path)

    tracks: list[Track] = []
    for camera in meta.cameras:
        try:
            every = np.ones(len(meta.episodes), np.bool_)
            tracks.append(make_track(meta, camera, columns["timestamp"], every, check))
        except FluxError as error:
            wrong.append(str(error))
    done, total = 0, frames * len(tracks)
    for track in tracks:
        before = len(wrong)
        for number, source in enumerate(track.files):
            try:
                if source not in damaged:
                    _decode(track, number, reporter, done, total)
            except FluxError as error:
                wrong.append(str(error))
            done += int((track.file == number).sum())
        if len(wrong) == before and damaged.isdisjoint(track.files):
            reporter.info(f"{track.key}: {frames} frames in {len(track.files)} files")
    reporter.progress("decode frames", total, total)
    _raise(meta, wrong)
    warnings = _find_warnings(meta, columns)
    for warning in warnings:
        reporter.warn(warning)
    return warnings


def _read_columns(meta: Metadata) -> dict[str, npt.NDArray[Any]]:
    """All rows. If a table is damaged, all that are: without rows no frame can be looked for."""
    try:
        return read_columns(meta, meta.vectors)
    except DataError as error:
        wrong = []
        for file in dict.fromkeys(meta.episodes.files):
            try:
                read_table(meta.data_file(file))
            except DataError as other:
                wrong.append(str(other))
        if len(wrong) > 1:
            _raise(meta, wrong)
        raise error


def _raise(meta: Metadata, wrong: list[str]) -> None:
    if len(wrong) == 1:
        raise DataError(wrong[0])
    if wrong:
        more = f"\n… and {len(wrong) - LISTED} more" if len(wrong) > LISTED else ""
        raise DataError(f"{meta.root}: {len(wrong)} findings\n" + "\n".join(wrong[:LISTED]) + more)


def _decode(track: Track, number: int, reporter: Reporter, done: int, total: int) -> None:
    pictures = open_source(track.files[number])
    try:
        for count, time in enumerate(np.sort(track.time[track.file == number])):
            image = pictures.read(float(time))
            if image.shape != (track.height, track.width, 3):
                raise DataError(
                    f"{pictures.path}: the frame at {time:.3f} s is {image.shape[0]} x "
                    f"{image.shape[1]}, info.json says {track.height} x {track.width}"
                )
            if count % EVERY == 0:
                reporter.progress("decode frames", done + count, total)
    finally:
        pictures.close()


def _wrong_times(meta: Metadata, timestamp: npt.NDArray[Any]) -> list[str]:
    """Episodes whose frames are not one period apart from 0 s on: other pictures would be shown."""
    starts = meta.episodes.first_row
    frame = np.arange(len(timestamp)) - np.repeat(starts, meta.episodes.lengths)
    off = np.abs(timestamp.astype(np.float64) - frame / meta.fps) * meta.fps >= 0.5
    if not off.any():
        return []
    row = int(np.flatnonzero(off)[0])
    episode = int(np.searchsorted(starts, row, side="right")) - 1
    return [
        f"{meta.root}: {off.sum()} timestamps are off by half a frame or more, for example "
        f"{timestamp[row]:.3f} s at frame {frame[row]} of episode {episode}, "
        f"{frame[row] / meta.fps:.3f} s expected"
    ]


def _find_warnings(meta: Metadata, columns: dict[str, npt.NDArray[Any]]) -> list[str]:
    found = []
    if meta.embodiment is None:
        found.append(
            f"{lerobot.EMBODIMENT} is missing: a policy acts only if its config says embodiment="
        )
    used = np.unique(columns["task_index"])
    empty = [int(i) for i in used if not meta.tasks[i].strip()]
    if empty:
        found.append(f"{meta.tasks_file}: no instruction for task_index {empty}")
    path = meta.root / lerobot.STATS
    if meta.version == lerobot.VERSION and path.is_file():
        found += [
            f"{lerobot.STATS}: {text} (FluxVLA computes its own); "
            "fluxvla data stats --write corrects it"
            for text in _wrong_statistics(read_json(path), meta, columns)
        ]
    return found


def _wrong_statistics(
    stated: dict[str, Any], meta: Metadata, columns: dict[str, npt.NDArray[Any]]
) -> list[str]:
    found = []
    for key in meta.vectors:
        entry = stated.get(key)
        if not isinstance(entry, dict):
            found.append(f"nothing about {key}")
            continue
        true = column_statistics(columns[key])
        lacking = [name for name in true if name not in entry]
        if lacking:
            found.append(f"{key} lacks {', '.join(lacking)}")
        # Means and deviations only: others' quantiles are estimates, and say so.
        scale = np.maximum(true["std"], 1e-3 * np.abs(true["mean"]) + 1e-6)
        for name in ("mean", "std"):
            try:
                value = np.asarray(entry.get(name, true[name]), np.float64)
            except (TypeError, ValueError):  # text, or rows of different lengths
                found.append(f"{key}: {name} is no list of numbers")
                continue
            if value.shape != true[name].shape or (abs(value - true[name]) > 0.01 * scale).any():
                found.append(f"{key}: {name} is not that of the data")
    return found
