"""LeRobot's dataset format: names of files, features and schemas of v3.0, and ``meta/info.json``.

Source: LeRobot 0.4.4 and 0.6.1 (codebase version v3.0); what they write is what this describes.

    meta/info.json                                   version, fps, features, totals, path patterns
    meta/stats.json                                  statistics of every feature
    meta/tasks.parquet                               instruction -> task_index
    meta/episodes/chunk-000/file-000.parquet         one row per episode
    data/chunk-000/file-000.parquet                  one row per frame, many episodes
    videos/<feature>/chunk-000/file-000.mp4          many episodes one after the other

FluxVLA adds two files that LeRobot ignores:

    meta/fluxvla_embodiment.json                     the robot that the numbers belong to
    meta/fluxvla_episodes.parquet                    each episode's key and pixel counts (merging)

``info.json`` may come from anybody, in any version: its numbers are bounded, and its path patterns
are checked before they are filled in, as ``str.format`` would pad a number to gigabytes.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath
from string import Formatter
from typing import Annotated, Any

from annotated_types import Ge, Le, MaxLen

from fluxvla_core.bounds import Count
from fluxvla_core.errors import DataError
from fluxvla_core.spec import LARGEST_SIDE, EmbodimentSpec
from fluxvla_core.untrusted import checked

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
CHUNK_EPISODES = 1000
"""Episodes of a folder in version 2, by default."""
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

MOST_PIXELS = 64_000_000
"""The most pixels of an image that is decoded, 192 MB; 8K video has 33 million."""
_NUMBERS = frozenset({"chunk_index", "file_index", "episode_chunk", "episode_index"})
_KEY = "video_key"
_WIDTH = re.compile(r"(?:0?\d{1,2})?d?")  # of LeRobot's: 03d, 06d


def image_feature(camera: str) -> str:
    """``top`` -> ``observation.images.top``; a feature's own name stays as it is."""
    return camera if camera.startswith(IMAGES) else IMAGES + camera


def camera_name(feature: str) -> str:
    """``observation.images.top`` -> ``top``."""
    return feature.removeprefix(IMAGES)


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
    """``value``, as int if it is whole: LeRobot writes frames per second as an integer."""
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


@dataclass(frozen=True)
class Feature:
    """One entry of ``features``: a column or a camera."""

    dtype: Annotated[str, MaxLen(100)]
    shape: Annotated[tuple[Count, ...], MaxLen(32)]
    names: Any = None
    info: dict[str, Any] | None = None
    video_info: dict[str, Any] | None = None


@dataclass(frozen=True)
class Info:
    """The entries of ``info.json`` that are read; it may hold more."""

    codebase_version: str
    fps: Annotated[float, Ge(0.001), Le(100_000)]
    features: Annotated[dict[str, Feature], MaxLen(10_000)]
    data_path: str
    total_episodes: Count
    total_frames: Count
    video_path: str | None = None
    chunks_size: Annotated[int, Ge(1), Le(1_000_000)] = CHUNK_EPISODES
    robot_type: str | None = None


def check_info(table: dict[str, Any], where: str) -> None:
    """Check ``info.json`` against the types above, and its path patterns.

    Raises:
        DataError: names the fields, and what they should be.
    """
    info = checked(table, Info, DataError, where)
    _check_pattern(info.data_path, "data_path", _NUMBERS, where)
    if info.video_path is not None:
        _check_pattern(info.video_path, "video_path", _NUMBERS | {_KEY}, where)
    for key, feature in info.features.items():
        if feature.dtype in ("video", "image"):
            _check_image(key, feature, where)


def fill(pattern: str, numbers: dict[str, int], key: str = "") -> str:
    """Fill the numbers and the camera's name into a checked path pattern.

    Raises:
        DataError: the camera's name would lead out of the dataset's folder.
    """
    path = pattern.format(**numbers, **{_KEY: key})
    if ".." in PurePosixPath(path).parts or "\0" in path:
        raise DataError(f"the feature {key!r} leads out of the dataset's folder", where=path)
    return path


def _check_image(key: str, feature: Feature, where: str) -> None:
    shape = feature.shape
    fits = len(shape) == 3 and all(1 <= side <= LARGEST_SIDE for side in shape)
    sides = shape[1:] if fits and shape[0] == 3 != shape[2] else shape[:2]
    if not fits or sides[0] * sides[1] > MOST_PIXELS:
        raise DataError(
            f"features.{key}.shape: an image is height x width x channels, each side from 1 to "
            f"{LARGEST_SIDE}, at most {MOST_PIXELS // 1_000_000} million pixels; got "
            f"{list(shape)[:8]}",
            where=where,
        )


def _check_pattern(pattern: str, name: str, known: frozenset[str], where: str) -> None:
    flaw = _flaw(pattern, known)
    if flaw:
        raise DataError(
            f"{name}: {flaw}: {pattern[:200]!r}",
            where=where,
            cause="no LeRobot wrote it: its patterns are like data/chunk-{chunk_index:03d}/"
            "file-{file_index:03d}.parquet",
        )


def _flaw(pattern: str, known: frozenset[str]) -> str | None:
    if len(pattern) > 1000:
        return "the pattern is longer than 1000 letters"
    path = PurePosixPath(pattern)
    if path.is_absolute() or ".." in path.parts or "\0" in pattern:
        return "the pattern leads out of the dataset's folder"
    try:
        parts = list(Formatter().parse(pattern))
    except ValueError as error:
        return f"no pattern ({error})"
    for _, field, width, conversion in parts:
        if field is None:
            continue
        if field not in known:
            return f"there is no {{{field[:40]}}} here, only {', '.join(sorted(known))}"
        if conversion or not (_WIDTH.fullmatch(width or "") if field != _KEY else not width):
            return f"{{{field}}} takes no width but one like 03d"
    return None
