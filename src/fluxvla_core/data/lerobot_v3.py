"""The layout of LeRobot's dataset format v3.0: names of files, features and schemas.

Source: LeRobot 0.4.4 and 0.6.1 (codebase version v3.0); what they write is what this describes.

    meta/info.json                                   version, fps, features, totals, path patterns
    meta/stats.json                                  statistics of every feature
    meta/tasks.parquet                               instruction -> task_index
    meta/episodes/chunk-000/file-000.parquet         one row per episode
    data/chunk-000/file-000.parquet                  one row per frame, many episodes
    videos/<feature>/chunk-000/file-000.mp4          many episodes one after the other

FluxVLA adds two files that LeRobot does not look at:

    meta/fluxvla_embodiment.json                     the robot that the numbers belong to
    meta/fluxvla_episodes.parquet                    each episode's key and pixel counts (merging)
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from fluxvla_core.spec.embodiment import EmbodimentSpec

VERSION = "v3.0"
INFO = "meta/info.json"
STATS = "meta/stats.json"
TASKS = "meta/tasks.parquet"
EPISODES = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EMBODIMENT = "meta/fluxvla_embodiment.json"
EXTRAS = "meta/fluxvla_episodes.parquet"

CHUNK_FILES = 1000
DATA_FILE_MB = 100
VIDEO_FILE_MB = 200

STATE = "observation.state"
ACTION = "action"
IMAGES = "observation.images."
INDEX_FEATURES: Mapping[str, str] = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}


def image_feature(camera: str) -> str:
    """``top`` -> ``observation.images.top``; a feature's own name stays as it is."""
    return camera if camera.startswith(IMAGES) else IMAGES + camera


def camera_name(feature: str) -> str:
    """``observation.images.top`` -> ``top``."""
    return feature.removeprefix(IMAGES)


def file_of(number: int) -> tuple[int, int]:
    """``(chunk_index, file_index)`` of the ``number``-th file of a kind."""
    return divmod(number, CHUNK_FILES)


def describe_features(
    embodiment: EmbodimentSpec, fps: float, codec: str
) -> dict[str, dict[str, Any]]:
    """``features`` of ``info.json``: cameras, state and action by their joints' names, indices.

    ``codec`` is the stream's name, ``h264`` or ``av1``.
    """
    features: dict[str, dict[str, Any]] = {}
    for camera in embodiment.cameras:
        features[image_feature(camera.name)] = {
            "dtype": "video",
            "shape": [camera.height, camera.width, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": camera.height,
                "video.width": camera.width,
                "video.codec": codec,
                "video.pix_fmt": "yuv420p",
                "video.is_depth_map": False,
                "video.fps": number(fps),
                "video.channels": 3,
                "has_audio": False,
            },
        }
    for key, names in ((STATE, embodiment.state_names), (ACTION, embodiment.joint_names)):
        features[key] = {"dtype": "float32", "shape": [len(names)], "names": list(names)}
    for key, dtype in INDEX_FEATURES.items():
        features[key] = {"dtype": dtype, "shape": [1], "names": None}
    return features


def number(value: float) -> int | float:
    """Whole numbers as int: LeRobot counts frames per second in integers."""
    return int(value) if float(value).is_integer() else float(value)


def datasets_schema(features: Mapping[str, Mapping[str, Any]]) -> bytes:
    """The ``huggingface`` entry of a data file's schema: the columns as ``datasets`` types."""
    columns: dict[str, Any] = {}
    for key, feature in features.items():
        if feature["dtype"] == "video":
            continue
        if feature["dtype"] == "image":
            columns[key] = {"_type": "Image"}
            continue
        value = {"dtype": feature["dtype"], "_type": "Value"}
        width = feature["shape"][0]
        single = feature["shape"] == [1]
        columns[key] = value if single else {"feature": value, "length": width, "_type": "List"}
    return json.dumps({"info": {"features": columns}}).encode()


def pandas_schema() -> bytes:
    """The ``pandas`` entry of ``tasks.parquet``: the column ``task`` is the frame's index."""

    def column(name: str, pandas_type: str, numpy_type: str) -> dict[str, Any]:
        return {
            "name": name,
            "field_name": name,
            "pandas_type": pandas_type,
            "numpy_type": numpy_type,
            "metadata": None,
        }

    text = {"name": None, "field_name": None, "pandas_type": "unicode", "numpy_type": "object"}
    return json.dumps(
        {
            "index_columns": ["task"],
            "column_indexes": [{**text, "metadata": {"encoding": "UTF-8"}}],
            "columns": [
                column("task_index", "int64", "int64"),
                column("task", "unicode", "object"),
            ],
            "attributes": {},
            "creator": {"library": "fluxvla-core", "version": "1"},
            "pandas_version": "2.0.0",
        }
    ).encode()
