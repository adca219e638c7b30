"""The pictures of samples: decoded when asked for, or all at once into memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.reporter import Reporter
from fluxvla_core.data.lanes import Lanes
from fluxvla_core.data.recording import Recorded, Track
from fluxvla_core.errors import DataError

Image = npt.NDArray[np.uint8]
Place = tuple[int, int]
AT_ONCE = 128
"""Pictures that are decoded between two words of progress; so many are in memory twice."""


class Frames:
    """Pictures by place: ``(recording, row)``.

    Args:
        recordings: whose tracks to read.
        cache: keep every usable frame in memory, uint8, once :meth:`prepare` was called.
    """

    def __init__(self, recordings: Sequence[Recorded], cache: bool) -> None:
        self._tracks = [r.tracks for r in recordings]
        self._rows = [r.rows for r in recordings]
        self._lanes = Lanes()
        self._cache = cache
        self._kept: list[list[Image]] | None = None

    def prepare(self, reporter: Reporter) -> None:
        """Fill the cache, if there is to be one; a second call does nothing.

        Raises:
            DataError: memory does not suffice, or a frame cannot be decoded.
        """
        if not self._cache or self._kept is not None:
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
                next="set cache_frames=False, or resize the pictures when recording",
            )
        total = sum(len(r) * len(t) for t, r in zip(self._tracks, self._rows, strict=True))
        done = 0
        kept: list[list[Image]] = []
        for tracks, rows in zip(self._tracks, self._rows, strict=True):
            kept.append([])
            for track in tracks:
                kept[-1].append(self._decode_all(track, rows, reporter, done, total))
                done += len(rows)
        self._kept = kept
        self._lanes.close()

    def read(self, places: Sequence[Place]) -> list[list[Image]]:
        """For each place one ``(3, height, width)`` uint8 array a camera (views of HWC memory).

        Raises:
            DataError: a frame is missing or cannot be decoded.
        """
        if self._kept is not None:
            return [
                [
                    kept[np.searchsorted(self._rows[part], row)].transpose(2, 0, 1)
                    for kept in self._kept[part]
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
        images = self._lanes.read([(source, time) for source, time, _, _ in wanted])
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
            images = self._lanes.read(wanted)
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


def available_memory() -> int | None:
    """Bytes that can be had without swapping; None where the system does not say."""
    try:
        with open("/proc/meminfo", encoding="ascii") as file:
            for line in file:
                if line.startswith("MemAvailable:"):
                    return int(line.split()[1]) * 1024
    except OSError:
        return None
    return None
