"""What an episode leaves behind: ``trace.jsonl``, a video for each camera, ``episode.json``.

Everything is handed over at once and written by a thread of its own: recording never makes a
command late. A disk that cannot keep up costs frames of the videos, never lines of the trace.
"""

from __future__ import annotations

import json
import os
import queue
import re
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import FluxError, RunFailed
from fluxvla_core.record.video import VideoWriter

TRACE = "trace.jsonl"
SUMMARY = "episode.json"
# Frames of all cameras that may wait for the encoder, about 30 MB at 640x480.
_WAITING_FRAMES = 32


class EpisodeTrace:
    """Writes one episode into ``folder``.

    Args:
        folder: made if need be; one episode each.
        video_fps: frames a second of the videos; None writes none.

    Raises:
        RunFailed: the folder cannot be made or written to.
    """

    def __init__(self, folder: Path, video_fps: float | None) -> None:
        self.folder = folder
        self.video_fps = video_fps
        self.dropped_frames = 0
        self._videos: dict[str, VideoWriter] = {}
        self._items: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._room = threading.Semaphore(_WAITING_FRAMES)
        self._error: Exception | None = None
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._file = (folder / TRACE).open("w", encoding="utf-8")
        except OSError as error:
            raise RunFailed(f"cannot record the episode: {error}", where=str(folder)) from error
        self._thread = threading.Thread(target=self._run, name="fluxvla-trace", daemon=True)
        self._thread.start()

    def write(self, record: Mapping[str, Any]) -> None:
        """Append one line; arrays may be among the values and must not change afterwards."""
        self._items.put(record)

    def frames(self, images: Mapping[str, npt.NDArray[np.uint8]]) -> None:
        """Append one ``(H, W, 3)`` uint8 frame to the video of each camera."""
        if self.video_fps is None:
            return
        for camera, image in images.items():
            if self._room.acquire(blocking=False):
                self._items.put((camera, image))
            else:
                self.dropped_frames += 1

    def close(self, summary: Mapping[str, Any]) -> None:
        """Finish every file; ``summary`` becomes ``episode.json``.

        Raises:
            RunFailed: something could not be written; what could be is there.
        """
        self._items.put(None)
        self._thread.join()
        text = json.dumps({**summary, "dropped_frames": self.dropped_frames}, indent=1)
        try:
            part = self.folder / (SUMMARY + ".part")
            part.write_text(text + "\n", encoding="utf-8")
            os.replace(part, self.folder / SUMMARY)
        except OSError as error:
            self._error = self._error or error
        if self._error is not None:
            what = self._error.what if isinstance(self._error, FluxError) else str(self._error)
            raise RunFailed(
                f"the episode could not be recorded completely: {what}", where=str(self.folder)
            ) from self._error

    def _run(self) -> None:
        while (item := self._items.get()) is not None:
            if isinstance(item, tuple):
                self._room.release()
            if self._error is None:
                self._guard(self._put, item)
        self._guard(self._file.close)
        for video in self._videos.values():
            self._guard(video.close)

    def _guard(self, call: Any, *arguments: Any) -> None:
        try:
            call(*arguments)
        except (OSError, FluxError, TypeError, ValueError) as error:
            self._error = self._error or error

    def _put(self, item: Any) -> None:
        if not isinstance(item, tuple):
            self._file.write(json.dumps(item, default=_plain) + "\n")
            return
        camera, image = item
        if camera not in self._videos:
            height, width = image.shape[:2]
            path = self.folder / f"{slug(camera)}.mp4"
            assert self.video_fps is not None
            self._videos[camera] = VideoWriter(path, self.video_fps, height, width)
        self._videos[camera].add(image)


def next_folder(root: Path, task: str) -> Path:
    """``<root>/<NNN>-<task>`` with the number after the highest there is."""
    numbers = [0]
    if root.is_dir():
        found = (re.match(r"(\d+)-", path.name) for path in root.iterdir())
        numbers += [int(match[1]) for match in found if match]
    return root / f"{max(numbers) + 1:03d}-{slug(task)}"


def slug(text: str) -> str:
    """``text`` as a file name: lower case, words joined by ``-``, at most 40 characters."""
    words = re.sub(r"[^0-9a-zA-Z_]+", "-", text).strip("-").lower()
    return words[:40].rstrip("-") or "task"


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a trace holds JSON values and arrays, not {type(value).__name__}")
