"""Where the events of an episode go: lines of JSON, or a bag that ROS tools open.

Both take the same events and give the same events back (``recording.recorded``); an episode has one
of them. A bag has the pictures too.
"""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from fluxvla_core.robot.recording import ros_messages as ros
from fluxvla_core.robot.recording.mcap import zstd

EVENTS_FILE = "trace.jsonl"
# Pictures of one topic that are remembered as written.
_REMEMBERED = 256
# On camera pictures a higher level saves a few percent and takes twice as long.
_LEVEL = 1


class Log(Protocol):
    """Events in; every method is called in one thread, but for the constructor."""

    def add(self, event: Mapping[str, Any]) -> None:
        """Append one event: JSON values and arrays, with ``event`` and ``t``."""

    def picture(
        self, camera: str, stamp: float, image: npt.NDArray[np.uint8], exact: bool = True
    ) -> None:
        """Append one ``(H, W, 3)`` uint8 RGB picture that arrived at ``stamp``.

        One that need not be ``exact`` may lose a little: a camera's whole stream is large.
        """

    def depth(self, camera: str, stamp: float, metres: npt.NDArray[np.float32]) -> None:
        """Append one ``(H, W)`` depth picture that arrived at ``stamp``."""

    def flush(self) -> None:
        """Give what is there to the system: a process that is killed then loses none of it."""

    def close(self) -> None:
        """Finish the file."""


def _json(value: Any) -> str:
    """A chunk row by row: one call for all of it would keep the interpreter from whoever sends."""
    if isinstance(value, np.ndarray) and value.ndim > 1:
        return "[" + ", ".join(map(_json, value)) + "]"
    return json.dumps(value, default=ros.plain)


class JsonLines:
    """``trace.jsonl`` in ``folder``. It holds no pictures."""

    def __init__(self, folder: Path) -> None:
        self._file = (folder / EVENTS_FILE).open("w", encoding="utf-8")

    def add(self, event: Mapping[str, Any]) -> None:
        fields = (f"{json.dumps(key)}: {_json(value)}" for key, value in event.items())
        self._file.write("{" + ", ".join(fields) + "}\n")

    def picture(
        self, camera: str, stamp: float, image: npt.NDArray[np.uint8], exact: bool = True
    ) -> None:
        return

    def depth(self, camera: str, stamp: float, metres: npt.NDArray[np.float32]) -> None:
        return

    def flush(self) -> None:
        self._file.flush()

    def close(self) -> None:
        self._file.close()


class Bag:
    """A rosbag2 with one MCAP file; ``folder`` must not exist and is made.

    Log times are real time: that of the first event, and from there on the loop's clock, so that a
    wall clock that is stepped meanwhile changes nothing. A picture that was looked at is written
    as it is, once; others become JPEGs, where OpenCV is installed.

    Args:
        folder: ``<folder>/<its name>.mcap`` and ``metadata.yaml``, which comes at the end.
        names: ``state`` and ``action`` -> joint names.

    Raises:
        RunFailed: rosbags is not installed.
        OSError: the folder cannot be made.
    """

    def __init__(self, folder: Path, names: Mapping[str, Sequence[str]]) -> None:
        store = ros.typestore()
        if folder.exists():
            raise FileExistsError(f"{folder} is there already")
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

        self._store = store
        self._packer = ros.Packer(store)
        self._names = names
        self._offset: int | None = None
        self._channels: dict[str, Any] = {}
        self._written: dict[str, deque[int]] = {}
        self._has_jpeg = ros.has_jpeg()
        # Version 8 of the metadata is read by every release from Humble on.
        self._writer: Any = Writer(folder, version=8, storage_plugin=StoragePlugin.MCAP)
        self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._writer.open()
        storage: Any = self._writer.storage
        storage.compressor = partial(zstd().compress, level=_LEVEL)

    def add(self, event: Mapping[str, Any]) -> None:
        stamps = {key: self._ns(event[key]) for key in ("t", "observed") if key in event}
        for topic, kind, data in self._packer.event(event, stamps, self._names):
            self._write(topic, kind, stamps["t"], data)

    def picture(
        self, camera: str, stamp: float, image: npt.NDArray[np.uint8], exact: bool = True
    ) -> None:
        ns = self._ns(stamp)
        kind = ros.IMAGE if exact or not self._has_jpeg else ros.JPEG
        topic = ros.camera_topic(camera, kind)
        if ns in self._written.get(ros.camera_topic(camera), ()) or not self._is_new(topic, ns):
            return
        pack = self._packer.picture if kind == ros.IMAGE else self._packer.jpeg
        self._write(topic, kind, ns, pack(camera, image, ns))

    def depth(self, camera: str, stamp: float, metres: npt.NDArray[np.float32]) -> None:
        ns, topic = self._ns(stamp), ros.depth_topic(camera)
        if self._is_new(topic, ns):
            self._write(topic, ros.IMAGE, ns, self._packer.depth(camera, metres, ns))

    def flush(self) -> None:
        storage = self._writer.storage
        if storage.chunk.msgs:
            storage.close_chunk()
        storage.bio.flush()

    def close(self) -> None:
        self._writer.close()

    def _is_new(self, topic: str, ns: int) -> bool:
        """Whether nothing of this time was written yet; from now on it was."""
        written = self._written.setdefault(topic, deque(maxlen=_REMEMBERED))
        if ns in written:
            return False
        written.append(ns)
        return True

    def _write(self, topic: str, kind: str, ns: int, data: memoryview) -> None:
        if topic not in self._channels:
            self._channels[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
        self._writer.write(self._channels[topic], ns, data)

    def _ns(self, seconds: float) -> int:
        if self._offset is None:
            self._offset = time.time_ns() - ros.nanoseconds(seconds)
        return self._offset + ros.nanoseconds(seconds)
