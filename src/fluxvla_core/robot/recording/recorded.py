"""A recorded episode, read back: its events, and the images of a bag.

An episode that was not recorded with ``record`` has events and no images: its policy can be
replayed, its robot cannot. What a process left that was killed is read as far as it goes.
"""

from __future__ import annotations

import os
import shutil
import struct
import warnings
from bisect import bisect_right
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core import atomic
from fluxvla_core.contracts.frame import STATE
from fluxvla_core.errors import DataError
from fluxvla_core.robot.recording import episode_log
from fluxvla_core.robot.recording import ros_messages as ros
from fluxvla_core.robot.recording.bag import McapFile, bag_writer
from fluxvla_core.robot.recording.trace import EVENTS_FILE, REST_FILE, SUMMARY_FILE
from fluxvla_core.spec import EmbodimentSpec, check_match
from fluxvla_core.untrusted import read_bytes

Array = npt.NDArray[np.float64]
Event = dict[str, Any]
Place = tuple[int, int, int]
# Times are rounded to nanoseconds on their way into a file.
ROUNDING_S = 1e-6
_LARGEST_TRACE = 1 << 30  # bytes: a day of one arm at 50 Hz


class RecordedImages:
    """One camera's images in the order of their times; each is read when it is asked for.

    ``times`` are seconds on the loop's clock, when each arrived.

    Args:
        file: the file that they are in.
        unpack: makes an array of a message and its type.
    """

    def __init__(
        self, file: McapFile, unpack: Callable[[memoryview, str], npt.NDArray[Any]]
    ) -> None:
        self.times: list[float] = []
        self._places: list[tuple[Place, str]] = []
        self._file = file
        self._unpack = unpack

    def __len__(self) -> int:
        return len(self.times)

    def add(self, time: float, place: Place, kind: str) -> None:
        """One more; out of order is allowed. Of two of one time the exact one is kept."""
        at = bisect_right(self.times, time)
        if at and self.times[at - 1] == time:
            if kind == ros.IMAGE:
                self._places[at - 1] = place, kind
            return
        self.times.insert(at, time)
        self._places.insert(at, (place, kind))

    def newest(self, time: float) -> int | None:
        """Index of the newest image that had arrived by ``time``; None before the first."""
        index = bisect_right(self.times, time + ROUNDING_S) - 1
        return index if index >= 0 else None

    def shown(self, time: float) -> npt.NDArray[Any]:
        """The newest image that had arrived by ``time``, or the first there is; see ``read``."""
        return self.read(self.newest(time) or 0)

    def read(self, index: int) -> npt.NDArray[Any]:
        """``(H, W, 3)`` uint8 RGB, or ``(H, W)`` float32 metres of depth; a fresh array."""
        place, kind = self._places[index]
        return self._unpack(self._file.read(place), kind)


class RecordedEpisode:
    """One recorded episode, as ``open_recording`` reads it.

    Args:
        path: the episode's folder, or its MCAP file.
        events: in the order in which they happened.
        finished: whether the record was finished.
        images: camera -> its images.
        depths: camera -> its depth images, NaN where nothing was measured.

    Raises:
        DataError: the record does not say what it is of.
    """

    def __init__(
        self,
        path: Path,
        events: Sequence[Event],
        finished: bool,
        images: Mapping[str, RecordedImages],
        depths: Mapping[str, RecordedImages] | None = None,
    ) -> None:
        if not events or events[0].get("event") != episode_log.START:
            raise DataError(
                "the record does not say what it is of",
                where=str(path),
                cause="it was cut short within its first half second, or an older version wrote it",
            )
        self.path = path
        self.events = events
        self.images = images
        self.depths = depths or {}
        self.finished = finished
        self.start = events[0]
        if self.start.get("format") != episode_log.FORMAT:
            raise DataError(
                f"the record is of format {self.start.get('format')!r}, not {episode_log.FORMAT!r}",
                where=str(path),
            )
        self.embodiment = EmbodimentSpec.from_dict(self.start.get("embodiment") or {})

    @property
    def pictures(self) -> Mapping[str, RecordedImages]:
        """Deprecated name of ``images``."""
        _renamed("RecordedEpisode", "pictures", "images")
        return self.images

    @property
    def whole(self) -> bool:
        """Deprecated name of ``finished``."""
        _renamed("RecordedEpisode", "whole", "finished")
        return self.finished

    @property
    def instruction(self) -> str:
        """The instruction of the episode."""
        return str(self.start.get("instruction") or "")

    @property
    def native(self) -> bool:
        """Whether every image that arrived was recorded, not only those that were looked at."""
        return bool(self.start.get("native"))

    @property
    def success(self) -> bool | None:
        """Whether the task was done; None where the robot does not report it."""
        ends = self.of(episode_log.END)
        found = ends[-1].get("success") if ends else None
        return None if found is None else bool(found)

    def of(self, kind: str) -> list[Event]:
        """The events of one kind."""
        return [event for event in self.events if event["event"] == kind]

    def commands(self, phase: str | None = None) -> tuple[Array, Array]:
        """Times ``(N,)`` and commands ``(N, D)``, of one phase or of all."""
        found = [e for e in self.of(episode_log.COMMAND) if phase in (None, e.get("phase"))]
        return self._rows(found, "command", self.embodiment.dim)

    def states(self) -> tuple[Array, Array]:
        """Times ``(N,)``, ascending, and states ``(N, state_dim)`` of every observation.

        A state that came with images is as old as they are: newer ones may have been read before
        it. Its time is when it arrived; one that was read with a command has the command's.
        """
        found = [e for e in self.events if e.get("state") is not None]
        found.sort(key=_arrived)
        _, values = self._rows(found, "state", self.embodiment.state_dim)
        return np.array([_arrived(e) for e in found], dtype=np.float64), values

    def _rows(self, events: Sequence[Event], name: str, width: int) -> tuple[Array, Array]:
        """Times ``(N,)`` and what each event has under ``name``, ``(N, width)``."""
        values = [event.get(name) or () for event in events]
        if any(len(value) != width for value in values):
            raise DataError(f"a {name} is no list of {width} numbers", where=str(self.path))
        times = np.array([event["t"] for event in events], dtype=np.float64)
        return times, np.array(values, dtype=np.float64).reshape(len(events), width)

    def chunks(self) -> list[Array]:
        """The policy's answers, ``(T, D)`` each."""
        dim, found = self.embodiment.dim, []
        for event in self.of(episode_log.CHUNK):
            rows = event.get(ros.KEYFRAMES) or []
            if not rows or any(len(row) != dim for row in rows):
                raise DataError(f"a chunk is no list of {dim} numbers", where=str(self.path))
            found.append(np.array(rows, dtype=np.float64))
        return found

    def summary(self) -> dict[str, Any]:
        """The content of ``episode.json``, computed again from the events."""
        return episode_log.summarise(self.events)


def open_recording(path: str | Path) -> RecordedEpisode:
    """Read one recorded episode.

    Args:
        path: its folder, its MCAP file, or a folder that holds it alone.

    Raises:
        DataError: there is none, there are several, or it cannot be read.
        RunFailed: rosbags is not installed.
    """
    found = find_recordings(path)
    if len(found) > 1:
        raise DataError(
            f"{len(found)} recorded episodes are here; name one of them: "
            + ", ".join(p.name for p in found[:8]),
            where=str(path),
        )
    return _read(found[0])


def find_recordings(path: str | Path) -> list[Path]:
    """The recorded episodes at ``path``: itself, or those in it, in the order of their names.

    Raises:
        DataError: there are none.
    """
    root = Path(path)
    if is_recording(root):
        return [root]
    found = sorted(p for p in root.glob("*/") if is_recording(p)) if root.is_dir() else []
    if not found:
        raise DataError(
            "there is no recorded episode here",
            where=str(root),
            cause=None if root.exists() else "there is no such file or folder",
            next="fluxvla run --config … --section inference --record DIR makes one",
        )
    return found


def is_recording(path: Path) -> bool:
    """Whether there are events of an episode at ``path``."""
    if path.is_dir():
        return bool(bag_of(path)) or (path / EVENTS_FILE).is_file()
    return path.suffix == ".mcap" and path.is_file()


def bag_of(folder: Path) -> Path | None:
    """The MCAP file in an episode's folder."""
    return next((file for file in sorted(folder.glob("*.mcap")) if os.path.isfile(file)), None)


def read_lines(path: Path) -> tuple[list[Event], bool]:
    """The events of a ``trace.jsonl``, and whether it is finished; half a last line is left out.

    Raises:
        DataError: another line is no event.
    """
    lines = read_bytes(path, DataError, at_most=_LARGEST_TRACE).splitlines(keepends=True)
    whole = not lines or lines[-1].endswith(b"\n")
    events: list[Event] = []
    for number, line in enumerate(lines if whole else lines[:-1], start=1):
        try:
            events.append(episode_log.parse_event(line, f"{path}:{number}"))
        except DataError as error:
            raise DataError(f"this line is no event: {error.what}", where=error.where) from error
    return events, whole and bool(events) and events[-1].get("event") == episode_log.END


@dataclass(frozen=True)
class BagContent:
    """Content of a bag: events, and where its images are (topic, type, ns, place)."""

    file: McapFile
    unpacker: ros.Unpacker
    events: list[Event]
    images: list[tuple[str, str, int, Place]]
    offset: int

    @property
    def pictures(self) -> list[tuple[str, str, int, Place]]:
        """Deprecated name of ``images``."""
        _renamed("BagContent", "pictures", "images")
        return self.images

    @property
    def finished(self) -> bool:
        """Whether it was finished."""
        return self.file.finished

    @property
    def whole(self) -> bool:
        """Deprecated name of ``finished``."""
        _renamed("BagContent", "whole", "finished")
        return self.finished


def read_bag(path: Path) -> BagContent:
    """Go through an MCAP file, finished or cut short.

    Raises:
        DataError: it is no MCAP file, or damaged before its end.
        RunFailed: rosbags is not installed.
    """
    unpacker = ros.Unpacker(ros.typestore())
    found = BagContent(McapFile(path), unpacker, [], [], 0)
    offset = 0
    try:
        for entry in found.file.entries():
            if entry.kind in ros.IMAGE_TYPES:
                found.images.append((entry.topic, entry.kind, entry.ns, entry.place))
                continue
            event = unpacker.add(entry.topic, entry.kind, entry.ns, entry.data)
            if event is not None:
                offset = offset or entry.ns - ros.nanoseconds(event["t"])
                found.events.append(event)
    except (ValueError, IndexError, OverflowError, MemoryError, struct.error) as error:
        raise DataError(
            f"a record in it cannot be read: {error}",
            where=str(path),
            cause="the file was damaged after it was written",
        ) from error
    return replace(found, offset=offset)


def _renamed(owner: str, old: str, new: str) -> None:
    message = f"{owner}.{old} is deprecated, use {new}"
    warnings.warn(message, DeprecationWarning, stacklevel=3)


def _read(path: Path) -> RecordedEpisode:
    file = bag_of(path) if path.is_dir() else path
    if file is None:
        return RecordedEpisode(path, *_with_rest(path, *read_lines(path / EVENTS_FILE)), images={})
    bag = read_bag(file)
    events, whole = _with_rest(file.parent, bag.events, bag.finished)
    cameras = RecordedEpisode(path, events, whole, {}).embodiment.camera_names
    colours = {ros.camera_topic(c, kind): c for c in cameras for kind in ros.IMAGE_TYPES}
    images = _sorted(bag, colours, bag.unpacker.image)
    depths = _sorted(bag, {ros.depth_topic(c): c for c in cameras}, bag.unpacker.depth)
    return RecordedEpisode(path, events, whole, images, depths)


def _with_rest(folder: Path, events: list[Event], whole: bool) -> tuple[list[Event], bool]:
    """``events`` with those that only the process knew that commanded the robot."""
    place = folder / REST_FILE
    if whole or not place.is_file():
        return events, whole
    rest, complete = read_lines(place)
    last = max((e["t"] for e in events if e["event"] == episode_log.COMMAND), default=-np.inf)
    later = [event for event in rest if event["t"] > last]
    return sorted([*events, *later], key=lambda event: float(event["t"])), complete


def _sorted(
    bag: BagContent,
    by_topic: Mapping[str, str],
    unpack: Callable[[memoryview, str], npt.NDArray[Any]],
) -> dict[str, RecordedImages]:
    """Camera -> its images on those of its topics that are named."""
    found: dict[str, RecordedImages] = {}
    for topic, kind, ns, place in bag.images:
        camera = by_topic.get(topic)
        if camera is not None:
            kept = found.setdefault(camera, RecordedImages(bag.file, unpack))
            kept.add((ns - bag.offset) / 1e9, place, kind)
    return found


def newest_at(times: Array, at: float | Array) -> npt.NDArray[np.intp]:
    """Index of the last of ascending ``times`` that is not after each of ``at``; at least 0."""
    index = np.searchsorted(times, np.asarray(at) + ROUNDING_S, side="right") - 1
    return np.maximum(index, 0)


def age_at(event: Event, stream: str) -> float:
    """How old, in seconds, a stream of an ``observation`` event was when it was looked at."""
    stamps: Mapping[str, float] = event.get("stamps") or {}
    stamp = stamps.get(stream, stamps.get(STATE, float(event["t"])))
    return max(0.0, float(event["t"]) - float(stamp))


def _arrived(event: Event) -> float:
    """When the state of an event arrived, as far as it is known."""
    return float(event["t"]) - (age_at(event, STATE) if "stamps" in event else 0.0)


def check_same_embodiment(recordings: Iterable[RecordedEpisode]) -> EmbodimentSpec:
    """The robot that all of them are of.

    Raises:
        SpecMismatch: two of them are of different robots; names both.
    """
    first, *others = recordings
    for other in others:
        who = (f"recording {first.path.name}", f"recording {other.path.name}")
        check_match(first.embodiment, other.embodiment, *who)
    return first.embodiment


def finish_recording(folder: str | Path) -> bool:
    """Write the index of a bag that lacks one, its ``metadata.yaml``, and ``episode.json``.

    The bag is written again to another file and put in its place in one step; its messages stay
    as they are.

    Args:
        folder: one episode.

    Returns:
        Whether there was anything to do.

    Raises:
        DataError: it holds no bag, or nothing that can be read.
        RunFailed: rosbags is not installed.
    """
    place = Path(folder)
    recorded = open_recording(place)
    bag = bag_of(place) if place.is_dir() else None
    if bag is None:
        raise DataError("only an episode's folder with a bag can be finished", where=str(place))
    if recorded.finished and (place / "metadata.yaml").is_file():
        return False
    aside = place.with_name(f".{place.name}.finishing")
    shutil.rmtree(aside, ignore_errors=True)
    try:
        written = aside / bag.stem
        _rewrite(McapFile(bag), written)
        os.replace(written / bag.name, bag)
        os.replace(written / "metadata.yaml", place / "metadata.yaml")
    finally:
        shutil.rmtree(aside, ignore_errors=True)
    if not (place / SUMMARY_FILE).exists():
        atomic.write_text(
            place / SUMMARY_FILE, atomic.json_text(recorded.summary(), indent=1) + "\n"
        )
    return True


def _rewrite(file: McapFile, out: Path) -> None:
    store, writer = ros.typestore(), bag_writer(out)
    channels: dict[str, Any] = {}
    with writer:
        for entry in file.entries():
            if entry.topic not in channels:
                channels[entry.topic] = writer.add_connection(
                    entry.topic, entry.kind, typestore=store
                )
            writer.write(channels[entry.topic], entry.ns, entry.data)
