"""Writing an episode's files: its events, a video for each camera, ``episode.json``.

Everything is handed over at once and written by a thread of its own: recording never makes a
command late. What waits to be written is bounded; what finds no room is dropped and counted,
images long before events.
"""

from __future__ import annotations

import json
import queue
import re
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from fluxvla_core import atomic
from fluxvla_core.control import realtime
from fluxvla_core.errors import FluxError, RunFailed
from fluxvla_core.robot.recording import ros_messages as ros
from fluxvla_core.robot.recording.bag import Bag
from fluxvla_core.robot.recording.video import VideoWriter

EVENTS_FILE = "trace.jsonl"
SUMMARY_FILE = "episode.json"
REST_FILE = "rest.jsonl"
"""The newest events of the process that commands the robot, where the one that records was killed:
its last half second, and how the robot was stopped."""
# What may wait: images in bytes (35 of 640x480 in colour), events in number (minutes of them).
_WAITING_BYTES = 32 * 1024 * 1024
_WAITING_EVENTS = 20_000
# How often the system is given what was written: so much is lost when the process is killed.
_FLUSH_S = 0.5
# How often the robot is asked for images that nobody looked at; it keeps the newest few.
_POLL_S = 0.03

Image = npt.NDArray[np.uint8]
Source = Callable[[str, float], tuple[Sequence[tuple[float, Image]], int]]
"""``images_after`` of an operator: camera and a time -> the kept ones of those that arrived
later, ``(stamp, image)``, oldest first, and how many arrived since it was connected. It must be
safe to call from any thread."""


class Log(Protocol):
    """A file that events are written to: JSON lines, or a bag for ROS tools, also with images.

    Both take the same events and give the same events back (``recording.recorded``). Every method
    is called in one thread, but for the constructor.
    """

    def add(self, event: Mapping[str, Any]) -> None:
        """Append one event: JSON values and arrays, with ``event`` and ``t``."""

    def image(
        self, camera: str, stamp: float, image: npt.NDArray[np.uint8], exact: bool = True
    ) -> None:
        """Append one ``(H, W, 3)`` uint8 RGB image that arrived at ``stamp``.

        One that need not be ``exact`` may lose a little: a camera's whole stream is large.
        A log that holds no images drops them.
        """
        return

    def depth(self, camera: str, stamp: float, metres: npt.NDArray[np.float32]) -> None:
        """Append one ``(H, W)`` depth image that arrived at ``stamp``."""
        return

    def flush(self) -> None:
        """Flush to the system: a process that is killed then loses none of it."""

    def close(self) -> None:
        """Finish the file."""


class JsonLines(Log):
    """A file of lines in ``folder``. It holds no images."""

    def __init__(self, folder: Path, name: str = EVENTS_FILE) -> None:
        self._file = (folder / name).open("w", encoding="utf-8")

    def add(self, event: Mapping[str, Any]) -> None:
        fields = (f"{json.dumps(key)}: {_json(value)}" for key, value in event.items())
        self._file.write("{" + ", ".join(fields) + "}\n")

    def flush(self) -> None:
        self._file.flush()

    def close(self) -> None:
        self._file.close()


def _json(value: Any) -> str:
    """A chunk as lists, row by row: one call for all would hold the GIL for too long."""
    if isinstance(value, np.ndarray) and value.ndim > 1:
        return "[" + ", ".join(map(_json, value)) + "]"
    return json.dumps(value, default=ros.numpy_as_json)


@dataclass(frozen=True)
class Recording:
    """The parts of a complete recording besides events and videos.

    Args:
        names: ``state`` and ``action`` -> joint names.
        cameras: those whose images are all recorded, if ``source`` gives them.
        source: see ``Source``; None: images are recorded when somebody looks. Videos show what
            it gives, too.
    """

    names: Mapping[str, Sequence[str]]
    cameras: Sequence[str] = ()
    source: Source | None = None


class _Poll:
    """One camera's images, as its robot gives them: up to when, and how many were missed."""

    def __init__(self, since: float) -> None:
        self.newest = since
        self._since = since
        self._frames = 0
        self._got = 0
        self._before: int | None = None
        self._received = 0

    def take(self, found: Sequence[tuple[float, Image]], received: int) -> None:
        if self._before is None:
            self._before = received - len(found)
        self._received = received
        self._got += len(found)
        self.newest = max((self.newest, *(stamp for stamp, _ in found)))

    def frames_until(self, stamp: float, fps: float | None) -> int:
        """How many frames of a video are due by ``stamp``."""
        if fps is None:
            return 0
        due = int((stamp - self._since) * fps) + 1 - self._frames
        self._frames += max(due, 0)
        return max(due, 0)

    @property
    def missed(self) -> int:
        return max(0, self._received - (self._before or 0) - self._got)


class EpisodeTrace:
    """Writes one episode into ``folder``.

    Args:
        folder: made if need be; one episode each.
        video_fps: frames a second of the videos; None writes none.
        recording: record into a bag, with images; None writes lines of JSON.

    Raises:
        RunFailed: the folder cannot be made or written to, or rosbags is not installed.
    """

    def __init__(
        self, folder: Path, video_fps: float | None, recording: Recording | None = None
    ) -> None:
        self.folder = folder
        self.video_fps = video_fps
        self.dropped = {"frames": 0, "images": 0, "events": 0}
        self._recording = recording
        self._source = recording.source if recording is not None else None
        self._cameras = recording.cameras if recording is not None else ()
        self._videos: dict[str, VideoWriter] = {}
        self._items: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._waiting = {"bytes": 0, "events": 0}
        self._polls: dict[str, _Poll] = {}
        self._flushed = self._looked = time.monotonic()
        self._error: Exception | None = None
        try:
            self._log = self._open()
        except OSError as error:
            raise RunFailed(f"cannot record the episode: {error}", where=str(folder)) from error
        self._thread = threading.Thread(target=self._run, name="fluxvla-trace", daemon=True)
        self._thread.start()

    def write(self, event: Mapping[str, Any]) -> None:
        """Append one event; arrays may be among the values and must not change afterwards."""
        if self._takes("events", 1, _WAITING_EVENTS):
            self._items.put(event)
        else:
            self.dropped["events"] += 1

    def frames(self, images: Mapping[str, Image]) -> None:
        """Append one ``(H, W, 3)`` uint8 frame to the video of each camera."""
        if self.video_fps is None or self._source is not None:
            return
        for camera, image in images.items():
            self._put_image("frames", (camera, None, image))

    def image(self, camera: str, stamp: float, image: Image) -> None:
        """Record a ``(H, W, 3)`` uint8 image that arrived at ``stamp``; once is enough."""
        if self._recording is not None:
            self._put_image("images", (camera, stamp, image))

    def depth(self, camera: str, stamp: float, metres: npt.NDArray[np.float32]) -> None:
        """Record an ``(H, W)`` depth image that arrived at ``stamp``; once is enough."""
        if self._recording is not None:
            self._put_image("images", (camera, stamp, metres))

    def close(self, summary: Mapping[str, Any]) -> dict[str, Any]:
        """Finish every file; ``summary`` and what was dropped become ``episode.json``.

        Raises:
            RunFailed: something could not be written; what could be is there.
        """
        self._items.put(None)
        self._thread.join()
        whole = {**summary, "dropped": dict(self.dropped)}
        try:
            atomic.write_text(self.folder / SUMMARY_FILE, atomic.json_text(whole, indent=1) + "\n")
        except OSError as error:
            self._error = self._error or error
        if self._error is not None:
            what = self._error.what if isinstance(self._error, FluxError) else str(self._error)
            raise RunFailed(
                f"the episode could not be recorded completely: {what}", where=str(self.folder)
            ) from self._error
        return whole

    def _open(self) -> Log:
        if self._recording is not None:
            return Bag(self.folder, self._recording.names)
        self.folder.mkdir(parents=True, exist_ok=True)
        return JsonLines(self.folder)

    def _run(self) -> None:
        # The sending thread waits for the GIL while this thread holds it.
        realtime.raise_priority()
        while True:
            try:
                item = self._items.get(timeout=_POLL_S)
            except queue.Empty:
                item = ()
            if item is None:
                break
            if item:
                self._give_back(item)
                if self._error is None:
                    self._guard(self._put, item)
            if self._error is None:
                self._guard(self._between)
        with realtime.normal_priority():
            self._finish()

    def _finish(self) -> None:
        self._guard(self._poll)
        self.dropped["images"] += sum(poll.missed for poll in self._polls.values())
        self._guard(self._log.close)
        for video in self._videos.values():
            self._guard(video.close)

    def _guard(self, call: Any, *arguments: Any) -> None:
        try:
            call(*arguments)
        except Exception as error:  # noqa: BLE001 - raised by close; the run continues
            self._error = self._error or error

    def _put(self, item: Any) -> None:
        if not isinstance(item, tuple):
            self._log.add(item)
            return
        camera, stamp, image = item
        with realtime.normal_priority():
            if stamp is None:
                self._film(camera, image)
            elif image.ndim == 2:
                self._log.depth(camera, stamp, image)
            else:
                self._log.image(camera, stamp, image)

    def _film(self, camera: str, image: Image) -> None:
        assert self.video_fps is not None
        if camera not in self._videos:
            height, width = image.shape[:2]
            path = self.folder / f"{slug(camera)}.mp4"
            self._videos[camera] = VideoWriter(path, self.video_fps, height, width)
        self._videos[camera].add(image)

    def _between(self) -> None:
        """Do the periodic work: poll, flush."""
        now = time.monotonic()
        if now - self._looked >= _POLL_S:
            self._looked = now
            self._poll()
        if now - self._flushed >= _FLUSH_S:
            self._flushed = now
            self._log.flush()

    def _poll(self) -> None:
        if self._source is None or self._error is not None:
            return
        with realtime.normal_priority():
            self._poll_all(self._source)

    def _poll_all(self, source: Source) -> None:
        for camera in self._cameras:
            poll = self._polls.setdefault(camera, _Poll(self._looked))
            try:
                found, received = source(camera, poll.newest)
            except FluxError:
                # The loop reads the same stream, and says what is wrong with it.
                continue
            poll.take(found, received)
            for stamp, image in found:
                self._log.image(camera, stamp, image, exact=False)
                for _ in range(poll.frames_until(stamp, self.video_fps)):
                    self._film(camera, image)

    def _put_image(self, what: str, item: tuple[str, float | None, npt.NDArray[Any]]) -> None:
        if self._takes("bytes", item[2].nbytes, _WAITING_BYTES):
            self._items.put(item)
        else:
            self.dropped[what] += 1

    def _takes(self, kind: str, amount: int, most: int) -> bool:
        with self._lock:
            if self._waiting[kind] + amount > most:
                return False
            self._waiting[kind] += amount
            return True

    def _give_back(self, item: Any) -> None:
        with self._lock:
            if isinstance(item, tuple):
                self._waiting["bytes"] -= item[2].nbytes
            else:
                self._waiting["events"] -= 1


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
