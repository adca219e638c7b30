"""Decode single camera frames, from mp4 files and from image columns of parquet files.

Opening a file costs more than decoding a frame, so open files are kept (least recently used ones
are closed). A frame is found by its time; the file's own index says at which key frame decoding
has to begin and whether decoding on from the last frame is shorter.

An image column (LeRobot's ``dtype: image``) holds ``{"bytes": PNG or JPEG, "path": its name}`` in
every row, as the Image feature of Hugging Face's ``datasets`` stores it. Rows are read by row
group; the last one is kept.
"""

from __future__ import annotations

import os
import struct
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.data.files import (
    arrow,
    first_line,
    libav,
    open_video,
    opencv,
    parquet,
    reformatter,
)
from fluxvla_core.data.lerobot import MOST_PIXELS
from fluxvla_core.errors import DataError

Image = npt.NDArray[np.uint8]
COPY_AGAIN = "copy the file again from where it came from; to decode every frame of a dataset: "


@dataclass(frozen=True)
class ImageColumn:
    """The image column ``key`` of the parquet file ``path``; every row's image is of ``size``."""

    path: Path
    key: str
    size: tuple[int, int]

    def __str__(self) -> str:
        return f"{self.path}: {self.key}"


Source = Path | ImageColumn
"""Where frames are: an mp4 file, or an image column."""


class VideoFile:
    """An open mp4 file.

    Raises:
        DataError: it is missing, cannot be opened, or holds no video.
    """

    def __init__(self, path: Path) -> None:
        av = libav()

        self.path = path
        self._coming: Any = None
        self._last: Any = None
        try:
            self._container: Any = open_video(path)
        except av.error.FFmpegError as error:
            raise DataError(
                f"{path}: cannot be opened as video ({error.strerror or error})",
                cause=_why_unopened(path),
            ) from error
        if not self._container.streams.video:
            self._container.close()
            raise DataError(f"{path}: holds no video stream")
        self._stream = self._container.streams.video[0]
        if self._stream.codec_context is None or not self._stream.time_base:
            self._container.close()
            raise DataError(f"{path}: its video cannot be decoded: no decoder, or no time base")
        # A seek throws away what decoding threads prepared; loading has its own workers.
        self._stream.thread_type = "NONE"
        self._stream.codec_context.thread_count = 1
        self._reformatter = reformatter()
        height, width = self.size
        if height * width > MOST_PIXELS:
            self.close()
            raise DataError(
                f"{path}: frames of {height} x {width}, {MOST_PIXELS // 1_000_000} million pixels "
                "are the most that are decoded"
            )
        rate = self._stream.average_rate
        self._tick = float(self._stream.time_base)
        self._step = max(1, round(1 / (float(rate) * self._tick))) if rate else 1

    @property
    def rate(self) -> float | None:
        """Frames per second, by the times in its index; None where those do not say."""
        entries = self._stream.index_entries
        count = len(entries)
        lasts = (entries[count - 1].timestamp - entries[0].timestamp) * self._tick if count else 0
        return (count - 1) / lasts if lasts > 0 else None

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self._stream.height, self._stream.width

    def whole_frames(self) -> int:
        """The number of frames that lie wholly within the file, by its index; decodes nothing."""
        end = self.path.stat().st_size
        return sum(entry.pos + entry.size <= end for entry in self._stream.index_entries)

    def read(self, time: float) -> Image:
        """Decode the frame shown at ``time`` seconds: ``(height, width, 3)`` uint8 RGB.

        Raises:
            DataError: there is no frame within half a frame of it, or it cannot be decoded.
        """
        av = libav()

        want = round(time / self._tick)
        try:
            frame = self._find(want)
        except av.error.FFmpegError as error:
            raise self._missing(time, str(error)) from error
        if frame is None:
            raise self._missing(time, "there is none")
        image: Image = self._reformatter.reformat(frame, format="rgb24", threads=1).to_ndarray()
        return image

    def close(self) -> None:
        self._coming = self._last = None
        self._container.close()

    def _find(self, want: int) -> Any | None:
        tolerance = self._step / 2
        if self._last is not None and abs(self._last.pts - want) < tolerance:
            return self._last
        if not self._reachable(want):
            self._seek(want)
        for frame in self._coming:
            if frame.pts is None or frame.pts < want - tolerance:
                continue
            self._last = frame
            return frame if frame.pts < want + tolerance else None
        self._last = None
        return None

    def _reachable(self, want: int) -> bool:
        """Whether decoding on gets to ``want`` sooner than a seek would."""
        if self._last is None or want < self._last.pts:
            return False
        if want - self._last.pts < 1.5 * self._step:
            return True
        entries = self._stream.index_entries
        key = entries.search_timestamp(want, backward=True, any_frame=False)
        return key >= 0 and bool(entries[key].timestamp <= self._last.pts)

    def _seek(self, want: int) -> None:
        self._last = None
        # Half a frame later: a rounded time just below a key frame must not lead to the one before.
        self._container.seek(want + self._step // 2, stream=self._stream)
        self._coming = self._container.decode(self._stream)

    def _missing(self, time: float, why: str) -> DataError:
        return DataError(
            f"{self.path}: no frame at {time:.3f} s ({why}); {self.whole_frames()} frames found",
            cause="the file is damaged, or belongs to another recording",
            next=f"{COPY_AGAIN}fluxvla data validate DATASET",
        )


class ImageColumnReader:
    """An open :class:`ImageColumn`; an image's time is its row.

    Raises:
        DataError: the file cannot be read, or the column holds no images.
    """

    def __init__(self, column: ImageColumn) -> None:
        pa = arrow()

        self.path = column
        try:
            self._file: Any = parquet().ParquetFile(column.path)
        except (pa.ArrowException, OSError, ValueError) as error:
            raise DataError(
                f"{column.path}: cannot be read as parquet ({first_line(error)})"
            ) from error
        schema = self._file.schema_arrow
        kind = schema.field(column.key).type if column.key in schema.names else pa.null()
        if not pa.types.is_struct(kind) or kind.get_field_index("bytes") < 0:
            self.close()
            raise DataError(f"{column} holds {kind}, not the bytes of images")
        about = self._file.metadata
        sizes = [about.row_group(i).num_rows for i in range(about.num_row_groups)]
        self._ends = np.cumsum(sizes)
        self._group = -1
        self._rows: Any = None

    def read(self, time: float) -> Image:
        """Decode the image of row ``time``: ``(height, width, 3)`` uint8 RGB.

        Raises:
            DataError: there is none, or it cannot be decoded.
        """
        row = round(time)
        data = self._bytes(row)
        if data is None:
            raise DataError(
                f"{self.path}: row {row} holds no image, at most the name of one",
                cause="the images were left in files of their own when this was written",
            )
        stated = image_size(data)
        if stated is not None and stated != self.path.size:
            raise DataError(
                f"{self.path}: the image of row {row} is {stated[0]} x {stated[1]}, "
                f"info.json says {self.path.size[0]} x {self.path.size[1]}"
            )
        cv2 = opencv()
        image = stated and cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        if image is None:
            raise DataError(f"{self.path}: the image of row {row} cannot be decoded")
        out: Image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
        return out

    def close(self) -> None:
        self._rows = None
        self._file.close()

    def _bytes(self, row: int) -> bytes | None:
        group = int(np.searchsorted(self._ends, row, side="right"))
        if group != self._group:
            self._rows, self._group = self._read_group(group), group
        first = int(self._ends[group]) - len(self._rows)
        found: bytes | None = self._rows[row - first].as_py()
        return found

    def _read_group(self, group: int) -> Any:
        try:
            table = self._file.read_row_group(group, columns=[self.path.key], use_threads=False)
        except (arrow().ArrowException, OSError, ValueError) as error:
            raise DataError(
                f"{self.path}: cannot be read ({first_line(error)})",
                cause="the file is damaged",
                next="copy the file again from where it came from",
            ) from error
        return table[self.path.key].combine_chunks().field("bytes")


def open_source(source: Source) -> VideoFile | ImageColumnReader:
    """Open ``source`` for reading frames. Raises DataError if it cannot be read."""
    return ImageColumnReader(source) if isinstance(source, ImageColumn) else VideoFile(source)


def read_frames(source: Source, times: Iterable[float]) -> Iterator[Image]:
    """Decode the frames of ``source`` at ``times``; fastest in ascending order.

    Raises:
        DataError: it cannot be read, or has no such frame.
    """
    file = open_source(source)
    try:
        for time in times:
            yield file.read(time)
    finally:
        file.close()


class FrameReader:
    """Reads frames of many files, keeping up to ``capacity`` of them open; not thread-safe."""

    def __init__(self, capacity: int = 32) -> None:
        self.capacity = capacity
        self._open: OrderedDict[Source, VideoFile | ImageColumnReader] = OrderedDict()
        self._owner = os.getpid()

    def read(self, source: Source, time: float) -> Image:
        """See :meth:`VideoFile.read`."""
        if self._owner != os.getpid():
            # After a fork both processes would move one shared file offset.
            self._open, self._owner = OrderedDict(), os.getpid()
        video = self._open.get(source)
        if video is None:
            video = self._open[source] = open_source(source)
            if len(self._open) > self.capacity:
                self._open.popitem(last=False)[1].close()
        else:
            self._open.move_to_end(source)
        return video.read(time)

    def close(self) -> None:
        while self._open:
            self._open.popitem()[1].close()

    def __getstate__(self) -> dict[str, Any]:
        return {"capacity": self.capacity, "_open": OrderedDict(), "_owner": -1}


@dataclass(frozen=True)
class ExpectedVideo:
    """Requirements for a video file: at least so many frames, of this size and rate."""

    frames: int
    height: int
    width: int
    fps: float


def check_video(path: Path, stated: ExpectedVideo) -> None:
    """Check a video file's index against what the dataset says; decodes nothing.

    Raises:
        DataError: the file is missing or truncated, or its frames are too few, or of another size
            or rate.
    """
    expected = stated.frames
    if not os.path.isfile(path):
        raise DataError(f"{path}: the video file is missing; {expected} frames expected")
    try:
        video = VideoFile(path)
    except DataError as error:
        raise DataError(
            f"{error.what}: {expected} frames expected, 0 found",
            cause=error.cause,
            next=f"{COPY_AGAIN}fluxvla data validate DATASET",
        ) from error
    found, size, rate = video.whole_frames(), video.size, video.rate
    video.close()
    if size != (stated.height, stated.width):
        raise DataError(
            f"{path}: frames of {size[0]} x {size[1]}, "
            f"info.json says {stated.height} x {stated.width}",
            cause="the file belongs to another dataset, or info.json was edited",
        )
    # Times in a file are rounded; a tenth off, and frames are not where they are looked for.
    if rate is not None and not 0.9 < rate / stated.fps < 1.1:
        raise DataError(
            f"{path}: {rate:g} frames a second, info.json says {stated.fps:g}",
            cause="the file belongs to another dataset, or info.json was edited",
        )
    if found < expected:
        raise DataError(
            f"{path}: {expected} frames expected, {found} found",
            cause="the file is truncated: its index points beyond its end"
            if count_indexed_frames(path) >= expected
            else "the recording was edited, or the file belongs to another dataset",
            next=f"{COPY_AGAIN}fluxvla data validate DATASET",
        )


def count_indexed_frames(path: Path) -> int:
    """The number of frames that a file's index lists, whether or not they are in the file."""
    with open_video(path) as container:
        return len(container.streams.video[0].index_entries)


def image_size(data: bytes) -> tuple[int, int] | None:
    """Height and width from the header of a PNG or JPEG; None for anything else.

    An image of a few bytes can decode to gigabytes, so this is checked first.
    """
    if data[:8] == b"\x89PNG\r\n\x1a\n" and data[12:16] == b"IHDR" and len(data) >= 24:
        width, height = struct.unpack_from(">II", data, 16)
        return height, width
    return _jpeg_size(data) if data[:2] == b"\xff\xd8" else None


def _why_unopened(path: Path) -> str:
    size = path.stat().st_size if path.is_file() else 0
    if size == 0:
        return "the file is empty or missing"
    return f"the file ({size} bytes) is truncated: the index at its end is missing"


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """From the first frame header (ITU-T T.81, B.2.2); segments before it are skipped."""
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # a fill byte
            at += 1
            continue
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", data, at + 5)
            return height, width
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return None
