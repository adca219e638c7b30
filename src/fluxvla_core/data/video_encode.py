"""Encode camera frames to mp4: one encoder an episode, episodes joined without re-encoding.

Every episode begins with a key frame and no frame refers across its end, so an episode is the
same bytes whichever process encoded it, and can be moved between files by copying packets.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.data.files import libav, open_video
from fluxvla_core.errors import ConfigError, DataError

_Scheduling = tuple[int, int]


@dataclass(frozen=True)
class Codec:
    """An encoder of libav: its name, the name of the stream that it makes, and its options."""

    encoder: str
    stream: str
    options: Mapping[str, str]


CODECS: Mapping[str, Codec] = {
    # A key frame every second frame makes random access cheap (LeRobot's choice too). No
    # B-frames: packets stay in display order. fastdecode doubles the decoding speed of small images
    # at the same size and quality. The same images must give the same bytes: unless weightp=0 says
    # again that there is no weighted prediction, and without mbtree=0, libx264 now and then makes
    # others, in one to two of a hundred files under load.
    "h264": Codec(
        "libx264",
        "h264",
        {
            "preset": "veryfast",
            "tune": "fastdecode",
            "weightp": "0",
            "mbtree": "0",
            "crf": "20",
            "g": "2",
            "bf": "0",
        },
    ),
    "libsvtav1": Codec("libsvtav1", "av1", {"preset": "10", "crf": "30", "g": "2"}),
}

# The index at the front lets a reader open the file without seeking to its end. The bit rate would
# be copied from whichever clip comes first, and differ between a recording and a merge.
_CONTAINER = {"movflags": "+faststart", "write_btrt": "0"}


def find_codec(name: str) -> Codec:
    """The codec called ``name``.

    Raises:
        ConfigError: no such name, or this build of libav lacks the encoder.
    """
    av = libav()

    codec = CODECS.get(name)
    if codec is None:
        raise ConfigError(f"video_codec {name!r} is not one of {', '.join(CODECS)}")
    if codec.encoder not in av.codecs_available:
        have = [n for n, c in CODECS.items() if c.encoder in av.codecs_available]
        raise ConfigError(
            f"video_codec {name!r}: this PyAV has no encoder {codec.encoder}",
            next=f"use one of: {', '.join(have) or 'none is available; reinstall av'}",
        )
    return codec


class EpisodeEncoder:
    """Encode one episode of one camera to ``path``.

    Args:
        height, width: of every image, even numbers (the colour planes have half the size).
        fps: frames per second.

    Raises:
        DataError: odd sizes.
    """

    def __init__(self, path: Path, height: int, width: int, fps: float, codec: Codec) -> None:
        av = libav()

        if height % 2 or width % 2:
            raise DataError(
                f"{path.stem}: images of {height} x {width} cannot be stored as video",
                cause="height and width must be even",
                next=f"collect them with --height {height + height % 2} --width "
                f"{width + width % 2}, or crop a pixel where they are made and say so in the "
                "embodiment",
            )
        if codec.encoder == "libsvtav1":
            os.environ.setdefault("SVT_LOG", "1")  # errors only; it prints a page a stream
        self.frames = 0
        self._container: Any = av.open(str(path), "w")
        rate = Fraction(fps).limit_denominator(1001)
        self._stream = self._container.add_stream(codec.encoder, rate=rate)
        self._stream.height, self._stream.width = height, width
        self._stream.pix_fmt = "yuv420p"
        self._stream.options = dict(codec.options)
        # Threads would make the bytes depend on the machine; collectors run side by side anyway.
        self._stream.codec_context.thread_count = 1
        with unchanged_scheduling():
            self._stream.codec_context.open()

    def add(self, image: npt.NDArray[np.uint8]) -> None:
        """Encode the next image, ``(height, width, 3)`` uint8 RGB."""
        av = libav()

        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        self._container.mux(self._stream.encode(frame))
        self.frames += 1

    def close(self) -> None:
        """Finish the file; without it the file cannot be read."""
        if self._container is not None:
            self._container.mux(self._stream.encode(None))
            self.abandon()

    def abandon(self) -> None:
        """Close the file as it is."""
        if self._container is not None:
            self._container.close()
            self._container = None


@dataclass(frozen=True)
class Clip:
    """``frames`` images of ``path`` from ``start`` seconds on, and how many bytes they take.

    ``delay`` is how many frames later than they are decoded some of them are shown; above 0 only
    for whole files.
    """

    path: Path
    frames: int
    size: int
    start: float = 0.0
    delay: int = 0


def join_clips(clips: Sequence[Clip], out: Path, fps: float) -> None:
    """Join clips one after the other into ``out``, by copying packets.

    Frame ``i`` of all is shown at ``i / fps``.

    Raises:
        DataError: a clip has other frames than it should, or they refer across its ends.
    """
    av = libav()

    step = Fraction(1) / Fraction(fps).limit_denominator(1001)
    delay = max(clip.delay for clip in clips)
    with (
        open_video(clips[0].path) as first,
        av.open(str(out), "w", options=_CONTAINER) as target,
    ):
        # Opaque: packets pass through, so the decoder need not have an encoder of its name.
        stream = target.add_stream_from_template(first.streams.video[0], opaque=True)
        done = 0
        for clip in clips:
            for count, (packet, shown) in enumerate(_packets(clip, step)):
                packet.pts = round((done + shown) * step / packet.time_base)
                packet.dts = round((done + count - delay) * step / packet.time_base)
                packet.stream = stream
                target.mux(packet)
            done += clip.frames


def whole_clip(path: Path, frames: int, fps: float) -> tuple[Clip, bytes]:
    """All of a file as a clip, and its stream's parameters: only equal ones can be joined.

    Raises:
        DataError: it has other frames than ``frames`` at ``0, 1 / fps, 2 / fps, …``.
    """
    step = Fraction(1) / Fraction(fps).limit_denominator(1001)
    clip = Clip(path, frames, path.stat().st_size, delay=frames)
    seen = [shown for _, shown in _packets(clip, step)]
    if sorted(seen) != list(range(frames)):
        raise DataError(
            f"{path}: its {frames} frames are not shown at {float(1 / step):g} Hz from 0 s on",
            cause="it was recorded at another rate than info.json says, or cut",
        )
    with open_video(path) as source:
        context = source.streams.video[0].codec_context
        size = f"{context.name} {context.width} {context.height} {context.pix_fmt} "
        parameters = size.encode() + bytes(context.extradata or b"")
    delay = max(count - shown for count, shown in enumerate(seen))
    return Clip(path, frames, clip.size, delay=delay), parameters


def _packets(clip: Clip, step: Fraction) -> Iterator[tuple[Any, int]]:
    """A clip's packets in decoding order, each with its place in display order."""
    av = libav()

    count = 0
    try:
        with open_video(clip.path) as source:
            stream = source.streams.video[0]
            first = round(Fraction(clip.start).limit_denominator(10**6) / stream.time_base)
            if first:
                source.seek(first, stream=stream)
            for packet in source.demux(stream):
                if packet.pts is None or packet.pts < first - step / stream.time_base / 2:
                    continue
                if count == clip.frames:
                    break
                shown = round((packet.pts - first) * stream.time_base / step)
                if count - shown > clip.delay or (count == 0 and not packet.is_keyframe):
                    raise DataError(
                        f"{clip.path}: the episode at {clip.start:.3f} s cannot be copied",
                        cause="its frames refer across its ends; another program wrote it",
                    )
                count += 1
                yield packet, shown
    except av.error.FFmpegError as error:
        raise DataError(f"{clip.path}: cannot be read as video ({error.strerror})") from error
    if count != clip.frames:
        raise DataError(f"{clip.path}: {clip.frames} frames expected, {count} found")


@contextlib.contextmanager
def unchanged_scheduling() -> Iterator[None]:
    """Context manager: restore thread priorities that a library raises inside.

    SVT-AV1, where it may (as root, which containers on robots often are), makes the thread that
    opens an encoder and all of its own real-time ones of the highest priority, and processes
    started later inherit that: nothing else on the machine runs while they do, least of all
    whatever sends commands to an arm.
    Source: ``svt_av1_enc_init`` and ``svt_create_thread`` of SVT-AV1 (``SCHED_FIFO``, 99).
    """
    if sys.platform != "linux":
        yield
        return
    mine, before = _scheduling(0), {tid: _scheduling(tid) for tid in _threads()}
    try:
        yield
    finally:
        for tid in _threads():
            should = before.get(tid) or mine
            now = _scheduling(tid)
            if should is not None and now is not None and now != should:
                # Lowering needs no right; a thread that has just ended needs nothing.
                with contextlib.suppress(ProcessLookupError):
                    os.sched_setscheduler(tid, should[0], os.sched_param(should[1]))


def _threads() -> list[int]:
    return [int(name) for name in os.listdir("/proc/self/task")]


def _scheduling(tid: int) -> _Scheduling | None:
    """Policy and priority; None for a thread that has ended."""
    try:
        return os.sched_getscheduler(tid), os.sched_getparam(tid).sched_priority
    except ProcessLookupError:
        return None
