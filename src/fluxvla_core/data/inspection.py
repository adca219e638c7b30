"""Describe and check datasets: ``fluxvla data inspect``, ``stats`` and ``validate``.

Opening a dataset checks its tables and the indices of its videos; ``validate`` also decodes every
frame, and does not stop at the first damaged file.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.runner import Reporter, SilentReporter
from fluxvla_core.data import lerobot
from fluxvla_core.data.columns import Track, check_tasks, make_track, read_columns
from fluxvla_core.data.files import read_json, read_table, write_metadata
from fluxvla_core.data.metadata import Metadata, read_metadata
from fluxvla_core.data.statistics import (
    LEVELS,
    Stats,
    as_lists,
    column_statistics,
    histogram_statistics,
    image_histogram,
)
from fluxvla_core.data.video_decode import ExpectedVideo, check_video, read_frames
from fluxvla_core.errors import DataError, FluxError

_COLUMNS = ("min", "q01", "mean", "q50", "q99", "max", "std")
_TASKS_SHOWN = 12
_FINDINGS_SHOWN = 20
_EVERY = 100
"""Frames between two reports of progress."""


def describe(root: Path) -> dict[str, Any]:
    """Describe a dataset as JSON values, from its tables and file sizes; decodes nothing.

    Raises:
        DataError: it cannot be read.
    """
    meta = read_metadata(root)
    columns = read_columns(meta, [])
    first = columns["task_index"][meta.episodes.first_row]
    lengths = meta.episodes.lengths
    data = {meta.data_file(file) for file in meta.episodes.files}
    spec = meta.embodiment
    return {
        "root": str(root),
        "version": meta.version,
        "robot_type": meta.info.get("robot_type"),
        "embodiment": None if spec is None else spec.name,
        "fps": lerobot.number(meta.fps),
        "episodes": len(lengths),
        "frames": int(lengths.sum()),
        "seconds": round(float(lengths.sum()) / meta.fps, 3),
        "episode_frames": {"min": int(lengths.min()), "max": int(lengths.max())},
        "tasks": [
            {"task_index": i, "task": task, "episodes": int((first == i).sum())}
            for i, task in enumerate(meta.tasks)
        ],
        "cameras": {key: _camera(meta, key) for key in meta.cameras},
        "vectors": {
            key: {"size": meta.vector(key), "names": meta.names(key)} for key in meta.vectors
        },
        "data": _size(data),
    }


def format_description(facts: Mapping[str, Any]) -> list[str]:
    """Format ``describe``'s facts for the terminal."""
    most, least = facts["episode_frames"]["max"], facts["episode_frames"]["min"]
    robot = facts["embodiment"] or "does not say (a config then says embodiment=)"
    out = [
        f"{facts['root']}: LeRobot {facts['version']}",
        f"  robot     {robot}",
        f"  episodes  {facts['episodes']}, of {least} to {most} frames",
        f"  frames    {facts['frames']} at {facts['fps']} Hz, {facts['seconds']:.0f} s in all",
    ]
    for key, camera in facts["cameras"].items():
        place = f"{camera['files']} files, {camera['bytes'] / 1e6:.1f} MB"
        place = place if camera["files"] else "in the tables"
        out.append(f"  camera    {key}: {camera['height']} x {camera['width']}, {place}")
    for key, vector in facts["vectors"].items():
        names = f": {', '.join(vector['names'])}" if vector["names"] else ""
        out.append(f"  vector    {key} ({vector['size']}){names}")
    out.append(f"  tables    {facts['data']['files']} files, {facts['data']['bytes'] / 1e6:.1f} MB")
    for task in facts["tasks"][:_TASKS_SHOWN]:
        out.append(f"  task {task['task_index']:4d} {task['episodes']} episodes: {task['task']}")
    if len(facts["tasks"]) > _TASKS_SHOWN:
        out.append(f"  … and {len(facts['tasks']) - _TASKS_SHOWN} more tasks")
    return out


def dataset_statistics(
    root: Path, pixels: bool, reporter: Reporter
) -> tuple[Metadata, dict[str, Stats]]:
    """Compute exact statistics of every vector and, with ``pixels``, camera (decodes all frames).

    Raises:
        DataError: the dataset cannot be read.
    """
    meta = read_metadata(root)
    columns = read_columns(meta, meta.vectors)
    stats = {key: column_statistics(columns[key]) for key in meta.vectors}
    if not pixels:
        return meta, stats
    every = np.ones(len(meta.episodes), np.bool_)
    frames = len(columns["timestamp"])
    total = frames * len(meta.cameras)
    for part, key in enumerate(meta.cameras):
        track = make_track(meta, key, columns["timestamp"], every)
        histogram = np.zeros((3, LEVELS), np.int64)
        done = part * frames
        for number in range(len(track.files)):
            for image in read_frames(track.files[number], _times(track, number)):
                histogram += image_histogram(image)
                done += 1
                if done % _EVERY == 0:
                    reporter.progress("count pixels", done, total)
        stats[key] = histogram_statistics(histogram, frames)
    reporter.progress("count pixels", total, total)
    return meta, stats


def format_statistics(meta: Metadata, stats: Mapping[str, Stats]) -> list[str]:
    """Format statistics for the terminal: a line for each entry of each feature."""
    out = []
    for key, entry in stats.items():
        out.append(f"{key}: {int(entry['count'][0])} frames")
        known = ["red", "green", "blue"] if key in meta.cameras else meta.names(key)
        names = known or [str(i) for i in range(entry["mean"].size)]
        width = max(6, *(len(name) for name in names))
        out.append(f"  {'':{width}}" + "".join(f"{name:>11}" for name in _COLUMNS))
        flat = {name: entry[name].ravel() for name in _COLUMNS}
        for i, name in enumerate(names):
            numbers = "".join(f"{flat[s][i]:11.4g}" for s in _COLUMNS)
            out.append(f"  {name:{width}}{numbers}{_idle_note({s: flat[s][i] for s in _COLUMNS})}")
    return out


def _idle_note(values: Mapping[str, float]) -> str:
    """A note on dimensions that a normalisation would divide by next to nothing."""
    if values["min"] == values["max"]:
        return "  never moves"
    return "  moves in under 2 % of the frames" if values["q01"] == values["q99"] else ""


def write_statistics(meta: Metadata, stats: Mapping[str, Stats]) -> Path:
    """Replace the entries of ``stats`` in ``meta/stats.json``, in one step.

    Raises:
        DataError: the dataset is of version 2, which keeps other statistics.
    """
    if meta.version != lerobot.VERSION:
        raise DataError(
            f"{meta.root}: {meta.version} keeps its statistics by episode, without quantiles",
            next=f"fluxvla data convert {meta.root} OUT",
        )
    path = meta.root / lerobot.STATS
    before = read_json(path) if path.is_file() else {}
    after = {**before, **{key: as_lists(entry) for key, entry in stats.items()}}
    write_metadata(path, after)
    return path


def _camera(meta: Metadata, key: str) -> dict[str, Any]:
    feature = meta.features[key]
    height, width = meta.image_size(key)
    stated = feature.get("info") or feature.get("video_info") or {}
    places = meta.episodes.videos.get(key)
    files = {meta.video_file(key, file) for file in places.files} if places else set()
    codec = stated.get("video.codec")
    return {"height": height, "width": width, "codec": codec, **_size(files)}


def _size(files: set[Path]) -> dict[str, int]:
    there = [os.path.getsize(path) for path in files if path.is_file()]
    return {"files": len(files), "bytes": sum(there)}


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
        more = (
            f"\n… and {len(wrong) - _FINDINGS_SHOWN} more" if len(wrong) > _FINDINGS_SHOWN else ""
        )
        raise DataError(
            f"{meta.root}: {len(wrong)} findings\n" + "\n".join(wrong[:_FINDINGS_SHOWN]) + more
        )


def _times(track: Track, number: int) -> list[float]:
    """When the frames in a track's ``number``-th file are shown, ascending."""
    times: list[float] = np.sort(track.time[track.file == number]).tolist()
    return times


def _decode(track: Track, number: int, reporter: Reporter, done: int, total: int) -> None:
    source, times = track.files[number], _times(track, number)
    for count, (time, image) in enumerate(zip(times, read_frames(source, times), strict=True)):
        if image.shape != (track.height, track.width, 3):
            raise DataError(
                f"{source}: the frame at {time:.3f} s is {image.shape[0]} x "
                f"{image.shape[1]}, info.json says {track.height} x {track.width}"
            )
        if count % _EVERY == 0:
            reporter.progress("decode frames", done + count, total)


def _wrong_times(meta: Metadata, timestamp: npt.NDArray[Any]) -> list[str]:
    """Episodes whose frames are not one period apart from 0 s on: other images would be shown."""
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
                found.append(f"{key}: {name} is not a list of numbers")
                continue
            if value.shape != true[name].shape or (abs(value - true[name]) > 0.01 * scale).any():
                found.append(f"{key}: {name} is not that of the data")
    return found
