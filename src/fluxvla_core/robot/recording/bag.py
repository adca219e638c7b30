"""MCAP files: ``Bag`` writes an episode as a rosbag2; ``McapFile`` reads one, also one cut short.

A process that is killed leaves no index at the end of its file. What it wrote until then is a
sequence of whole records, and this reads records, so that nothing of it is lost. Format:
https://mcap.dev/spec. Only what rosbags writes is understood: the ROS 2 profile, chunks that are
plain or compressed with zstd.
"""

from __future__ import annotations

import struct
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import DataError
from fluxvla_core.robot.recording import ros_messages as ros

# Images of one topic that are remembered as written.
_REMEMBERED = 256
# On camera images a higher level saves a few percent and takes twice as long.
_LEVEL = 1
MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 0x02, 0x03, 0x04, 0x05, 0x06
# Images of one moment lie side by side; a reader that goes through time needs few chunks.
_KEPT_CHUNKS = 8
_LARGEST_CHUNK = 1 << 30  # bytes; rosbags begins another after 1 MiB, or an image


class Bag:
    """A rosbag2 with one MCAP file; ``folder`` must not exist and is made.

    Log times are real time: that of the first event, and from there on the loop's clock, so that a
    wall clock that is stepped meanwhile changes nothing. An image that was looked at is written
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
        self._store = store
        self._packer = ros.Packer(store)
        self._names = names
        self._offset: int | None = None
        self._channels: dict[str, Any] = {}
        self._written: dict[str, deque[int]] = {}
        self._has_jpeg = ros.has_jpeg()
        self._writer = bag_writer(folder)
        self._writer.open()
        storage: Any = self._writer.storage
        storage.compressor = partial(zstd().compress, level=_LEVEL)

    def add(self, event: Mapping[str, Any]) -> None:
        stamps = {key: self._ns(event[key]) for key in ("t", "observed") if key in event}
        for topic, kind, data in self._packer.event(event, stamps, self._names):
            self._write(topic, kind, stamps["t"], data)

    def image(
        self, camera: str, stamp: float, image: npt.NDArray[np.uint8], exact: bool = True
    ) -> None:
        ns = self._ns(stamp)
        kind = ros.IMAGE if exact or not self._has_jpeg else ros.JPEG
        topic = ros.camera_topic(camera, kind)
        if ns in self._written.get(ros.camera_topic(camera), ()) or not self._is_new(topic, ns):
            return
        pack = self._packer.image if kind == ros.IMAGE else self._packer.jpeg
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


@dataclass(frozen=True)
class Entry:
    """One message.

    Args:
        topic, kind: of its channel; ``kind`` as ``sensor_msgs/msg/Image``.
        ns: log time, nanoseconds since the epoch.
        data: CDR.
        place: where ``McapFile.read`` finds ``data`` again: chunk's offset, start, end.
    """

    topic: str
    kind: str
    ns: int
    data: memoryview
    place: tuple[int, int, int]


class McapFile:
    """The messages of one file, in the order in which they were written.

    Args:
        path: the file.

    ``finished`` is set by going through ``entries`` to their end: whether the file was finished.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.finished = False
        self._chunk = lru_cache(maxsize=_KEPT_CHUNKS)(self._read_chunk)

    def entries(self) -> Iterator[Entry]:
        """Every message.

        Raises:
            DataError: this is no MCAP file, or it is damaged before its end.
        """
        self.finished = False
        channels: dict[int, tuple[str, str]] = {}
        schemas: dict[int, str] = {}
        with self._opened() as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise DataError("this is no MCAP file", where=str(self.path))
            size = self.path.stat().st_size
            while True:
                at = file.tell()
                head = file.read(9)
                if len(head) < 9 or file.tell() + _length(head) > size:
                    return  # cut short: what is here is no whole record
                if head[0] == _FOOTER:
                    self.finished = True
                    return
                if head[0] != _CHUNK:
                    file.seek(_length(head), 1)
                    continue
                file.seek(at)
                content = self._chunk(at)
                for start, end, code in _records(content, self.path):
                    body = content[start:end]
                    if code == _SCHEMA:
                        schemas[_u16(body, 0)] = _text(body, 2)[0]
                    elif code == _CHANNEL:
                        topic, _ = _text(body, 4)
                        channels[_u16(body, 0)] = topic, schemas.get(_u16(body, 2), "")
                    elif code == _MESSAGE:
                        topic, kind = channels.get(_u16(body, 0), ("", ""))
                        (ns,) = struct.unpack_from("<Q", body, 6)
                        yield Entry(topic, kind, ns, body[22:], (at, start + 22, end))
                file.seek(at + 9 + _length(head))

    def read(self, place: tuple[int, int, int]) -> memoryview:
        """The CDR bytes of a message that ``entries`` gave.

        Raises:
            DataError: the file cannot be read any more.
        """
        at, start, end = place
        return self._chunk(at)[start:end]

    def _opened(self) -> BinaryIO:
        try:
            return self.path.open("rb")
        except OSError as error:
            raise DataError(f"cannot be read: {error.strerror}", where=str(self.path)) from error

    def _read_chunk(self, at: int) -> memoryview:
        with self._opened() as file:
            file.seek(at)
            body = file.read(_length(file.read(9)))
        try:
            _, _, size, _ = struct.unpack_from("<QQQI", body, 0)
            compression, start = _text(body, 28)
        except (struct.error, ValueError) as error:
            raise DataError(
                f"the chunk at byte {at} cannot be read: {error}", where=str(self.path)
            ) from error
        if size > _LARGEST_CHUNK:
            raise DataError(
                f"the chunk at byte {at} unpacks to {size} bytes, {_LARGEST_CHUNK} are the most",
                where=str(self.path),
            )
        content = memoryview(body)[start + 8 :]
        if compression == "zstd":
            content = memoryview(_unpack(bytes(content), size, self.path))
        elif compression:
            raise DataError(
                f"a chunk is compressed with {compression!r}; zstd is what recordings use",
                where=str(self.path),
            )
        if len(content) != size:
            raise DataError(
                f"the chunk at byte {at} holds {len(content)} bytes, {size} were written",
                where=str(self.path),
                cause="the file was damaged after it was written",
            )
        return content


def bag_writer(folder: Path) -> Any:
    """A rosbags writer of compressed MCAP, not opened yet; ``folder`` must not exist."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    # Version 8 of the metadata is read by every release from Humble on.
    writer = Writer(folder, version=8, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    return writer


def zstd() -> Any:
    """The zstd module, wherever this Python has it; rosbags requires it."""
    try:
        from compression import zstd as module  # type: ignore[import-not-found,unused-ignore]
    except ImportError:
        from backports import zstd as module  # type: ignore[no-redef,unused-ignore]
    return module


def _unpack(content: bytes, size: int, path: Path) -> bytes:
    """At most one byte more than ``size``: a few bytes can unpack to any number."""
    module = zstd()
    try:
        unpacked: bytes = module.ZstdDecompressor().decompress(content, max_length=size + 1)
    except module.ZstdError as error:
        raise DataError(
            f"a chunk cannot be decompressed: {error}",
            where=str(path),
            cause="the file was damaged after it was written",
        ) from error
    return unpacked


def _records(content: memoryview, path: Path) -> Iterator[tuple[int, int, int]]:
    """Start, end and opcode of each record in a chunk."""
    at = 0
    while at < len(content):
        start = at + 9
        end = start + _length(content[at:start])
        if end > len(content):
            raise DataError("a record is longer than its chunk", where=str(path))
        yield start, end, content[at]
        at = end


def _length(head: bytes | memoryview) -> int:
    (length,) = struct.unpack_from("<Q", head, 1)
    return int(length)


def _u16(body: bytes | memoryview, at: int) -> int:
    (value,) = struct.unpack_from("<H", body, at)
    return int(value)


def _text(body: bytes | memoryview, at: int) -> tuple[str, int]:
    """A string and where what comes after it begins."""
    (length,) = struct.unpack_from("<I", body, at)
    end = at + 4 + length
    return bytes(body[at + 4 : end]).decode("utf-8"), end
