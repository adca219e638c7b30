"""Single frames out of mp4 files, accurately and fast.

Opening a file costs more than decoding a frame, so open files are kept (least recently used ones
are closed). A frame is found by its time; the file's own index says at which key frame decoding
has to begin and whether going on from the last frame is shorter.
"""

from __future__ import annotations

import os
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.data.optional import libav, reformatter
from fluxvla_core.data.stored_images import ImageColumn, StoredImages
from fluxvla_core.errors import DataError

Image = npt.NDArray[np.uint8]
Source = Path | ImageColumn
COPY_AGAIN = "copy the file again from where it came from; to decode every frame of a dataset: "


class VideoFile:
    """One open mp4.

    Raises:
        DataError: it is missing, cannot be opened, or holds no video.
    """

    def __init__(self, path: Path) -> None:
        av = libav()

        self.path = path
        try:
            self._container: Any = av.open(str(path))
        except av.error.FFmpegError as error:
            raise DataError(
                f"{path}: cannot be opened as video ({error.strerror or error})",
                cause=_why_unopened(path),
            ) from error
        if not self._container.streams.video:
            self._container.close()
            raise DataError(f"{path}: holds no video stream")
        self._stream = self._container.streams.video[0]
        # A seek throws away what decoding threads prepared; loading has its own workers.
        self._stream.thread_type = "NONE"
        self._stream.codec_context.thread_count = 1
        self._reformatter = reformatter()
        rate = self._stream.average_rate
        self._tick = float(self._stream.time_base)
        self._step = max(1, round(1 / (float(rate) * self._tick))) if rate else 1
        self._coming: Any = None
        self._last: Any = None

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self._stream.height, self._stream.width

    def whole_frames(self) -> int:
        """How many frames lie wholly within the file, by its index; nothing is decoded."""
        end = self.path.stat().st_size
        return sum(entry.pos + entry.size <= end for entry in self._stream.index_entries)

    def read(self, time: float) -> Image:
        """The frame shown at ``time`` seconds, ``(height, width, 3)`` uint8 RGB.

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


def open_source(source: Source) -> VideoFile | StoredImages:
    """What reads the frames of ``source``. Raises DataError if it cannot be read."""
    return StoredImages(source) if isinstance(source, ImageColumn) else VideoFile(source)


class VideoFiles:
    """Frames of many files; keeps up to ``capacity`` of them open."""

    def __init__(self, capacity: int = 32) -> None:
        self.capacity = capacity
        self._open: OrderedDict[Source, VideoFile | StoredImages] = OrderedDict()
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


def check_video(path: Path, expected: int) -> None:
    """Open ``path`` and compare its index with what the dataset says; nothing is decoded.

    Raises:
        DataError: the file is missing, truncated, or has fewer than ``expected`` frames.
    """
    if not path.is_file():
        raise DataError(f"{path}: the video file is missing; {expected} frames expected")
    try:
        video = VideoFile(path)
    except DataError as error:
        raise DataError(
            f"{error.what}: {expected} frames expected, 0 found",
            cause=error.cause,
            next=f"{COPY_AGAIN}fluxvla data validate DATASET",
        ) from error
    found = video.whole_frames()
    video.close()
    if found < expected:
        raise DataError(
            f"{path}: {expected} frames expected, {found} found",
            cause="the file is truncated: its index points beyond its end"
            if len_of_index(path) >= expected
            else "the recording was edited, or the file belongs to another dataset",
            next=f"{COPY_AGAIN}fluxvla data validate DATASET",
        )


def len_of_index(path: Path) -> int:
    """How many frames the file's index lists, whether or not they are there."""
    av = libav()

    with av.open(str(path)) as container:
        return len(container.streams.video[0].index_entries)


def _why_unopened(path: Path) -> str:
    size = path.stat().st_size if path.is_file() else 0
    if size == 0:
        return "the file is empty or missing"
    return f"the file ({size} bytes) is truncated: the index at its end is missing"
