"""The newest messages of an operator's streams: checked for age, matched in time, as images."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.ros2 import discovery, images, sync
from fluxvla_core.ros2.connection import Connection
from fluxvla_core.ros2.streams import CAMERA, DEPTH, STATE, Received, StreamSpec
from fluxvla_core.ros2.sync import Stale
from fluxvla_core.spec import Camera

TimedImages = tuple[list[tuple[float, npt.NDArray[np.uint8]]], int]
# How often a wait for messages that belong together looks again.
POLL_S = 0.002


class StreamReader:
    """The newest messages of the streams of one connection.

    Args:
        connection: with all streams subscribed.
        specs: the streams.
        max_age_s, max_skew_s, sync_on: see ``RosOperator``.
    """

    def __init__(
        self,
        connection: Connection,
        specs: Sequence[StreamSpec],
        max_age_s: float,
        max_skew_s: float,
        sync_on: str,
    ) -> None:
        self._connection = connection
        self._specs = specs
        self._states = [spec.name for spec in specs if spec.kind == STATE]
        self._in_frames = [spec.name for spec in specs if spec.kind in (STATE, CAMERA, DEPTH)]
        self._max_age = max_age_s
        self._max_skew = max_skew_s
        self._sync_on = sync_on

    def newest(self) -> dict[str, Received]:
        """The newest message of every stream that has one.

        Raises:
            Stale: a stream is silent that should not be.
            Faulted: the connection broke.
        """
        self._connection.check()
        streams = self._connection.streams
        newest = {spec.name: streams[spec.name].newest() for spec in self._specs}
        watched = {
            spec.name: newest[spec.name]
            for spec in self._specs
            if not spec.latched and (spec.required or newest[spec.name] is not None)
        }
        silent = sync.silent(watched, time.monotonic(), self._max_age)
        if silent:
            whole = len(silent) == len(watched)
            raise discovery.silent_streams(self._connection, silent, self._max_age, whole)
        return {name: received for name, received in newest.items() if received is not None}

    def states(self, index: int = -1) -> dict[str, Received]:
        """One message of each ``state`` stream, which has had one, whatever their ages are.

        Args:
            index: -1 for the newest, -2 for the one before it, or the newest if it is the only one.
        """
        streams = self._connection.streams
        return {name: streams[name].ring.last(-index)[0] for name in self._states}

    def check_states_together(self) -> None:
        """Refuse ``state`` streams whose newest messages are of different times.

        Raises:
            Stale: their stamps are too far apart.
        """
        if self._sync_on == "stamp" and not self._clock_stepped():
            streams = self._connection.streams
            newest = {name: streams[name].ring.last(sync.CLOCK_SAMPLES) for name in self._states}
            sync.check_together(newest, self._max_skew, sync.wall_offset())

    def matched(self) -> Mapping[str, Received]:
        """Messages of state, cameras and depth that belong together, one of each stream.

        Waits up to ``max_age_s`` for them: a burst puts a stream apart from the others for a
        moment, one that fell silent is named as such in this time, and only a driver that is late
        stays apart.

        Raises:
            Stale: a stream is silent or late, or they are too far apart in time.
            Faulted: the connection broke.
        """
        until = time.monotonic() + self._max_age
        while True:
            self.newest()
            by = "receipt" if self._clock_stepped() else self._sync_on
            streams = self._connection.streams
            kept = {name: streams[name].ring.items() for name in self._in_frames}
            try:
                self.check_states_together()
                match = sync.match(kept, self._max_skew, by, sync.wall_offset())
                sync.check_age(match, time.monotonic(), self._max_age)
            except Stale:
                if time.monotonic() >= until:
                    raise
                time.sleep(POLL_S)
            else:
                return match.messages

    def frame_images(
        self, messages: Mapping[str, Received]
    ) -> tuple[dict[str, npt.NDArray[np.uint8]], dict[str, npt.NDArray[np.float32]]]:
        """The colour and depth images of a frame, by camera name, in fresh arrays.

        Args:
            messages: stream -> the message to convert; of ``matched``.

        Raises:
            BadMessage: an image has another size or encoding than its camera; names stream and
                topic.
        """
        colours: dict[str, npt.NDArray[np.uint8]] = {}
        depths: dict[str, npt.NDArray[np.float32]] = {}
        for spec in self._specs:
            if spec.camera is None:
                continue
            message = messages[spec.name].message
            if spec.kind == CAMERA:
                colours[spec.camera.name] = _rgb(spec, spec.camera, message)
            elif spec.kind == DEPTH:
                depths[spec.camera.name] = images.to_depth(
                    message, spec.camera.height, spec.camera.width, spec.label
                )
        return colours, depths

    def images_after(self, camera: str, after: float) -> TimedImages:
        """The colour images of a camera that are newer than ``after``: see ``RosOperator``.

        None for a camera that has no stream.
        """
        for spec in self._specs:
            if spec.kind == CAMERA and spec.camera is not None and spec.camera.name == camera:
                ring = self._connection.streams[spec.name].ring
                found = [
                    (received.receipt, _rgb(spec, spec.camera, received.message))
                    for received in ring.items()
                    if received.receipt > after
                ]
                return found, ring.received - ring.duplicates - ring.overtaken
        return [], 0

    def _clock_stepped(self) -> bool:
        """Whether a sender's clock stepped so recently that stamps on both sides are kept."""
        since = time.monotonic() - self._max_age
        steps = [stream.ring.stepped_at for stream in self._connection.streams.values()]
        return any(at is not None and at > since for at in steps)


def _rgb(spec: StreamSpec, camera: Camera, message: Any) -> npt.NDArray[np.uint8]:
    grey = camera.encoding in images.GREY
    return images.to_rgb(message, camera.height, camera.width, spec.label, grey)
