"""Many pictures at once, decoded side by side by threads that each keep files of their own.

libav lets other threads run while it decodes, and half of what a sample with video costs is that.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

from fluxvla_core.data.video import Image, Source, VideoFiles

MOST = 4
"""Lanes: open files take memory in each; who wants more loads with workers."""
OPEN_FILES = 32
"""Of all lanes together."""


class Lanes:
    """Reads pictures of any files; not for two threads at once."""

    def __init__(self) -> None:
        self._lanes: list[VideoFiles] = []

    def read(self, wanted: Sequence[tuple[Source, float]]) -> list[Image]:
        """The frames shown at those times, ``(height, width, 3)`` uint8 RGB each.

        Give them in the order of the files: each lane reads one stretch, so that neighbours
        share an open decoder, and the next time it has the same files open.

        Raises:
            DataError: a frame is missing or cannot be decoded.
        """
        lanes = self._prepared(threads())
        if len(lanes) == 1 or len(wanted) < 2:
            return _read(lanes[0], wanted)
        ends = [len(wanted) * i // len(lanes) for i in range(len(lanes) + 1)]
        stretches = [wanted[a:b] for a, b in pairwise(ends)]
        # Threads that end are nothing that a fork for loader workers could lose.
        with ThreadPoolExecutor(len(lanes)) as pool:
            return [image for images in pool.map(_read, lanes, stretches) for image in images]

    def close(self) -> None:
        for files in self._lanes:
            files.close()
        self._lanes = []

    def _prepared(self, count: int) -> list[VideoFiles]:
        if len(self._lanes) != count:
            self.close()
            self._lanes = [VideoFiles(OPEN_FILES // count) for _ in range(count)]
        return self._lanes


def threads() -> int:
    """How many may decode: no more than torch may use, which is one in a loader's worker."""
    torch = sys.modules.get("torch")
    return min(MOST, int(torch.get_num_threads())) if torch is not None else 1


def _read(files: VideoFiles, wanted: Sequence[tuple[Source, float]]) -> list[Image]:
    return [files.read(source, time) for source, time in wanted]
