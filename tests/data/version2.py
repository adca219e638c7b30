"""Datasets of LeRobot v2.1, written by hand: what wrote them is no longer installed anywhere."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fluxvla_core.data.statistics import column_statistics, histogram_statistics, image_histogram
from fluxvla_core.data.video_encode import EpisodeEncoder, find_codec

CAMERAS = ("top", "wrist")
JOINTS = ["waist", "elbow", "gripper"]
FPS = 10
STORED = ("png", "jpg")


def write_v2(
    root: Path, takes: Sequence[Any], version: str = "v2.1", chunk: int = 2, codec: str = "h264"
) -> Path:
    """Episodes one file each, ``chunk`` of them in a folder; the jsonl lines in no order.

    ``codec`` may be ``png`` or ``jpg`` too: images then stand in the tables.
    """
    tasks = list(dict.fromkeys(take.task for take in takes))
    rows = {"episodes": [], "tasks": [], "episodes_stats": []}
    rows["tasks"] = [{"task_index": i, "task": task} for i, task in enumerate(tasks)][::-1]
    start = 0
    for i, take in enumerate(takes):
        columns = frame_columns(take, i, tasks.index(take.task), start)
        start += len(take.state)
        path = root / f"data/chunk-{i // chunk:03d}/episode_{i:06d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        table = {k: column(a) for k, a in columns.items()}
        if codec in STORED:
            for camera in CAMERAS:
                table[f"observation.images.{camera}"] = stored_images(getattr(take, camera), codec)
        pq.write_table(pa.table(table), path, row_group_size=5)
        stats = {k: column_statistics(a.reshape(len(a), -1)) for k, a in columns.items()}
        for camera in CAMERAS:
            key = f"observation.images.{camera}"
            if codec not in STORED:
                path = root / f"videos/chunk-{i // chunk:03d}/{key}/episode_{i:06d}.mp4"
                write_video(path, getattr(take, camera), codec)
            histogram = sum(image_histogram(image) for image in getattr(take, camera))
            stats[key] = histogram_statistics(histogram, len(take.state))
        old = ("min", "max", "mean", "std", "count")
        listed = {k: {n: s[n].tolist() for n in old} for k, s in stats.items()}
        rows["episodes"].insert(
            0, {"episode_index": i, "tasks": [take.task], "length": len(take.state)}
        )
        rows["episodes_stats"].append({"episode_index": i, "stats": listed})
    for name, lines in rows.items():
        path = root / f"meta/{name}.jsonl"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    described = info(takes, tasks, version, chunk)
    if codec in STORED:
        for camera in CAMERAS:
            described["features"][f"observation.images.{camera}"].update(dtype="image", info=None)
        described.update(video_path=None, total_videos=0)
    (root / "meta/info.json").write_text(json.dumps(described))
    return root


def stored_images(images: np.ndarray, kind: str) -> Any:
    """A column as the Image feature of Hugging Face's datasets stores it."""
    files = [cv2.imencode(f".{kind}", image[..., ::-1])[1].tobytes() for image in images]
    rows = [{"bytes": data, "path": f"frame-{i:06d}.{kind}"} for i, data in enumerate(files)]
    return pa.array(rows, pa.struct([("bytes", pa.binary()), ("path", pa.string())]))


def write_video(path: Path, images: np.ndarray, codec: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    encoder = EpisodeEncoder(path, *images.shape[1:3], FPS, find_codec(codec))
    for image in images:
        encoder.add(image)
    encoder.close()


def frame_columns(take: Any, episode: int, task: int, start: int) -> dict[str, np.ndarray]:
    frames = np.arange(len(take.state))
    return {
        "observation.state": take.state,
        "action": take.action,
        "timestamp": (frames / FPS).astype(np.float32),
        "frame_index": frames,
        "episode_index": np.full(len(frames), episode),
        "index": start + frames,
        "task_index": np.full(len(frames), task),
        "next.done": frames == frames[-1],
    }


def column(array: np.ndarray) -> Any:
    flat = pa.array(array.ravel())
    return pa.FixedSizeListArray.from_arrays(flat, array.shape[1]) if array.ndim == 2 else flat


def info(takes: Sequence[Any], tasks: Sequence[str], version: str, chunk: int) -> dict[str, Any]:
    features: dict[str, Any] = {
        "observation.state": {"dtype": "float32", "shape": [3], "names": JOINTS},
        "action": {"dtype": "float32", "shape": [3], "names": JOINTS},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
        "next.done": {"dtype": "bool", "shape": [1], "names": None},
    }
    for name in ("frame_index", "episode_index", "index", "task_index"):
        features[name] = {"dtype": "int64", "shape": [1], "names": None}
    for camera in CAMERAS:
        features[f"observation.images.{camera}"] = {
            "dtype": "video",
            "shape": list(getattr(takes[0], camera).shape[1:]),
            "names": ["height", "width", "channels"],
            "info": {"video.fps": FPS, "video.codec": "h264", "video.pix_fmt": "yuv420p"},
        }
    return {
        "codebase_version": version,
        "robot_type": "arm",
        "total_episodes": len(takes),
        "total_frames": sum(len(take.state) for take in takes),
        "total_tasks": len(tasks),
        "total_videos": len(takes) * len(CAMERAS),
        "total_chunks": -(-len(takes) // chunk),
        "chunks_size": chunk,
        "fps": FPS,
        "splits": {"train": f"0:{len(takes)}"},
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/"
        "episode_{episode_index:06d}.mp4",
        "features": features,
    }
