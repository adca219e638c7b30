"""Describe a dataset and compute its statistics: ``fluxvla data inspect`` and ``stats``."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fluxvla_core.contracts.reporter import Reporter
from fluxvla_core.data import lerobot
from fluxvla_core.data.columns import make_track, read_columns
from fluxvla_core.data.files import read_json, write_json
from fluxvla_core.data.metadata import Metadata, read_metadata
from fluxvla_core.data.statistics import (
    LEVELS,
    Stats,
    as_lists,
    column_statistics,
    histogram_statistics,
    image_histogram,
)
from fluxvla_core.data.video_decode import open_source
from fluxvla_core.errors import DataError

SHOWN = ("min", "q01", "mean", "q50", "q99", "max", "std")
_TASKS_SHOWN = 12


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


def lines(facts: Mapping[str, Any]) -> list[str]:
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
        for number, source in enumerate(track.files):
            pictures = open_source(source)
            for time in np.sort(track.time[track.file == number]):
                histogram += image_histogram(pictures.read(float(time)))
                done += 1
                if done % 100 == 0:
                    reporter.progress("count pixels", done, total)
            pictures.close()
        stats[key] = histogram_statistics(histogram, frames)
    reporter.progress("count pixels", total, total)
    return meta, stats


def table(meta: Metadata, stats: Mapping[str, Stats]) -> list[str]:
    """Format statistics for the terminal: a line for each entry of each feature."""
    out = []
    for key, entry in stats.items():
        out.append(f"{key}: {int(entry['count'][0])} frames")
        known = ["red", "green", "blue"] if key in meta.cameras else meta.names(key)
        names = known or [str(i) for i in range(entry["mean"].size)]
        width = max(6, *(len(name) for name in names))
        out.append(f"  {'':{width}}" + "".join(f"{name:>11}" for name in SHOWN))
        flat = {name: entry[name].ravel() for name in SHOWN}
        for i, name in enumerate(names):
            numbers = "".join(f"{flat[s][i]:11.4g}" for s in SHOWN)
            out.append(f"  {name:{width}}{numbers}{_idle_note({s: flat[s][i] for s in SHOWN})}")
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
    write_json(path, after)
    return path


def _camera(meta: Metadata, key: str) -> dict[str, Any]:
    feature = meta.features[key]
    height, width = meta.picture_size(key)
    stated = feature.get("info") or feature.get("video_info") or {}
    places = meta.episodes.videos.get(key)
    files = {meta.video_file(key, file) for file in places.files} if places else set()
    codec = stated.get("video.codec")
    return {"height": height, "width": width, "codec": codec, **_size(files)}


def _size(files: set[Path]) -> dict[str, int]:
    there = [os.path.getsize(path) for path in files if path.is_file()]
    return {"files": len(files), "bytes": sum(there)}
