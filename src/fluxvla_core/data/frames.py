"""Camera frames of samples: decoded on demand by a few threads, or cached in memory.

libav releases the GIL while it decodes, and half of the cost of a sample with video is decoding.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.runner import Reporter
from fluxvla_core.data.columns import LoadedDataset, Track
from fluxvla_core.data.video_decode import FrameReader, Image, Source
from fluxvla_core.errors import DataError

Place = tuple[int, int]
AT_ONCE = 128
"""Frames that are decoded between two reports of progress; so many are in memory twice."""
MAX_THREADS = 4
"""Decoder threads of a process: each keeps files open; to use more cores, load with workers."""
MAX_OPEN_FILES = 32
"""Open video files of all decoder threads of a dataset together."""


class Frames:
    """Camera frames by place: ``(dataset, row)``.

    Args:
        datasets: whose tracks to read.
        cache: keep every usable frame in memory, uint8, once :meth:`prepare` was called.
    """

    def __init__(self, datasets: Sequence[LoadedDataset], cache: bool) -> None:
        self._tracks = [d.tracks for d in datasets]
        self._rows = [d.rows for d in datasets]
        self._decoders = DecoderThreads()
        self._cache = cache
        self._cached: list[list[Image]] | None = None

    def prepare(self, reporter: Reporter) -> None:
        """Fill the cache, if there is one; a second call does nothing.

        Raises:
            DataError: memory does not suffice, or a frame cannot be decoded.
        """
        if not self._cache or self._cached is not None:
            return
        needed = sum(
            len(rows) * t.height * t.width * 3
            for tracks, rows in zip(self._tracks, self._rows, strict=True)
            for t in tracks
        )
        free = available_memory()
        if free is not None and needed > 0.8 * free:
            raise DataError(
                f"cache_frames=True needs {needed / 1e9:.1f} GB, {free / 1e9:.1f} GB are free",
                next="--set train_dataloader.dataset.cache_frames=false, or resize the images "
                "when recording",
            )
        total = sum(len(r) * len(t) for t, r in zip(self._tracks, self._rows, strict=True))
        done = 0
        kept: list[list[Image]] = []
        for tracks, rows in zip(self._tracks, self._rows, strict=True):
            kept.append([])
            for track in tracks:
                kept[-1].append(self._decode_all(track, rows, reporter, done, total))
                done += len(rows)
        self._cached = kept
        self._decoders.close()

    def read(self, places: Sequence[Place]) -> list[list[Image]]:
        """Each place's ``(3, height, width)`` uint8 arrays, one a camera (views of HWC memory).

        Raises:
            DataError: a frame is missing or cannot be decoded.
        """
        if self._cached is not None:
            return [
                [
                    kept[np.searchsorted(self._rows[part], row)].transpose(2, 0, 1)
                    for kept in self._cached[part]
                ]
                for part, row in places
            ]
        found: list[list[Any]] = [[None] * len(self._tracks[part]) for part, _ in places]
        wanted = [
            (track.files[track.file[row]], float(track.time[row]), i, camera)
            for i, (part, row) in enumerate(places)
            for camera, track in enumerate(self._tracks[part])
        ]
        # In the order of the files: neighbours share an open decoder, sometimes a group of frames.
        wanted.sort(key=lambda w: (str(w[0]), *w[1:]))
        images = self._decoders.read([(source, time) for source, time, _, _ in wanted])
        for (_, _, i, camera), image in zip(wanted, images, strict=True):
            found[i][camera] = image.transpose(2, 0, 1)
        return found

    def _decode_all(
        self,
        track: Track,
        rows: npt.NDArray[np.int64],
        reporter: Reporter,
        done: int,
        total: int,
    ) -> Image:
        out = np.empty((len(rows), track.height, track.width, 3), np.uint8)
        order = np.lexsort((track.time[rows], track.file[rows]))
        for first in range(0, len(order), AT_ONCE):
            some = order[first : first + AT_ONCE]
            wanted = [(track.files[track.file[row]], float(track.time[row])) for row in rows[some]]
            images = self._decoders.read(wanted)
            for i, image, (source, _) in zip(some, images, wanted, strict=True):
                if image.shape != out.shape[1:]:
                    raise DataError(
                        f"{source}: frames of {image.shape[0]} x {image.shape[1]}, "
                        f"info.json says {track.height} x {track.width}"
                    )
                out[i] = image
            reporter.progress("decode frames", done + first + len(some), total)
        out.flags.writeable = False  # samples are views of it
        return out


class DecoderThreads:
    """Decodes frames of any files in threads that each keep files open. Call it from one thread."""

    def __init__(self) -> None:
        self._readers: list[FrameReader] = []

    def read(self, wanted: Sequence[tuple[Source, float]]) -> list[Image]:
        """Decode the frames shown at those times, ``(height, width, 3)`` uint8 RGB each.

        Give them in the order of the files: each thread reads one stretch, so that neighbours
        share an open decoder, and the next call finds the same files open.

        Raises:
            DataError: a frame is missing or cannot be decoded.
        """
        readers = self._prepared(thread_count())
        if len(readers) == 1 or len(wanted) < 2:
            return _read(readers[0], wanted)
        ends = [len(wanted) * i // len(readers) for i in range(len(readers) + 1)]
        stretches = [wanted[a:b] for a, b in pairwise(ends)]
        # Threads end with each call: a fork for data workers would lose ones that stayed.
        with ThreadPoolExecutor(len(readers)) as pool:
            return [image for images in pool.map(_read, readers, stretches) for image in images]

    def close(self) -> None:
        for reader in self._readers:
            reader.close()
        self._readers = []

    def _prepared(self, count: int) -> list[FrameReader]:
        if len(self._readers) != count:
            self.close()
            self._readers = [FrameReader(MAX_OPEN_FILES // count) for _ in range(count)]
        return self._readers


def thread_count() -> int:
    """Threads that may decode: no more than torch may use, which is one in a data worker."""
    torch = sys.modules.get("torch")
    return min(MAX_THREADS, int(torch.get_num_threads())) if torch is not None else 1


def available_memory() -> int | None:
    """Bytes of memory available without swapping; None where the system does not say."""
    try:
        with open("/proc/meminfo", encoding="ascii") as file:
            for line in file:
                if line.startswith("MemAvailable:"):
                    return int(line.split()[1]) * 1024
    except OSError:
        return None
    return None


def _read(reader: FrameReader, wanted: Sequence[tuple[Source, float]]) -> list[Image]:
    return [reader.read(source, time) for source, time in wanted]
