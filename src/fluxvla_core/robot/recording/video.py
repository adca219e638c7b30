"""mp4 (H.264) from RGB frames by PyAV: what evaluation and inference show people.

Not the datasets' writer: those need exact frame times and many episodes in one file.
"""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import DataError, RunFailed


class VideoWriter:
    """Write frames of one size to ``path``; the file appears when ``close`` is called.

    It is written beside its name and renamed when complete, so that a video that exists can be
    played. H.264 has no odd sizes in yuv420p: an odd last row or column is dropped.

    Args:
        path: the mp4 to make; its folder is made if need be.
        fps: frames a second.
        height, width: size of every frame in pixels.

    Raises:
        RunFailed: the ``av`` package is missing, or the file cannot be written.
    """

    def __init__(self, path: Path | str, fps: float, height: int, width: int) -> None:
        self.path = Path(path)
        self.shape = (height, width, 3)
        self.frames = 0
        self._part = self.path.with_name(self.path.name + ".part")
        try:
            import av
        except ImportError as error:
            raise RunFailed(
                f"cannot write {self.path.name}: the package 'av' is not installed",
                next="pip install 'fluxvla-core[data]'",
            ) from error
        self._av = av
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._container: Any = av.open(
                str(self._part), "w", format="mp4", options={"movflags": "+faststart"}
            )
        except OSError as error:
            raise RunFailed(f"cannot write a video: {error}", where=str(self.path)) from error
        rate = Fraction(fps).limit_denominator(1000)
        self._stream = self._container.add_stream("libx264", rate=rate)
        self._stream.height = height - height % 2
        self._stream.width = width - width % 2
        self._stream.pix_fmt = "yuv420p"
        self._stream.thread_count = 1
        self._stream.options = {"preset": "veryfast", "crf": "23"}

    def add(self, frame: npt.NDArray[np.uint8]) -> None:
        """Append one ``(height, width, 3)`` uint8 RGB frame.

        Raises:
            DataError: another shape or dtype.
            RunFailed: the disk is full, or the file was taken away.
        """
        if frame.shape != self.shape or frame.dtype != np.uint8:
            raise DataError(
                f"this video takes {self.shape} uint8 frames, got {frame.shape} {frame.dtype}",
                where=str(self.path),
            )
        even = np.ascontiguousarray(frame[: self._stream.height, : self._stream.width])
        image = self._av.VideoFrame.from_ndarray(even, format="rgb24")
        self._mux(self._stream.encode(image))
        self.frames += 1

    def close(self) -> None:
        """Finish the file and give it its name; a video without frames leaves none."""
        if self._container is None:
            return
        container, self._container = self._container, None
        try:
            if self.frames:
                for packet in self._stream.encode():
                    container.mux(packet)
            container.close()
            if self.frames:
                self._part.replace(self.path)
        except OSError as error:
            raise RunFailed(f"cannot finish the video: {error}", where=str(self.path)) from error
        finally:
            self._part.unlink(missing_ok=True)

    def _mux(self, packets: Any) -> None:
        try:
            for packet in packets:
                self._container.mux(packet)
        except OSError as error:
            raise RunFailed(f"cannot write the video: {error}", where=str(self.path)) from error

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
