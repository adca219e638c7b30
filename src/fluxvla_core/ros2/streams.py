"""Streams and commands of an operator: their declarations, and subscriptions to messages."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from fluxvla_core.ros2 import qos
from fluxvla_core.ros2.messages import COMPRESSED_IMAGE, IMAGE, JOINT_STATE, stamp_of
from fluxvla_core.spec import Camera

STATE, CAMERA, DEPTH, AUXILIARY = "state", "camera", "depth", "auxiliary"
"""Kinds of streams. Auxiliary ones (a robot's mode, its base) must be fresh, but their messages are
not matched in time with the others."""

# Long enough to find the state that belongs to an image that took 0.2 s, at 500 Hz.
_STATE_DEPTH = 128
# Images are large; the newest few are enough to match cameras with one another.
_IMAGE_DEPTH = 4
# Messages that wait in the middleware while the ROS thread is busy elsewhere.
_QUEUE = 10
STEP = 1.0
"""Seconds by which a stamp must jump against the receipt times to be a step of the sender's clock,
and not a message that was overtaken."""


@dataclass(frozen=True)
class StreamSpec:
    """One subscription.

    Args:
        name: the stream's name in frames and messages; a camera's name for images.
        topic: the topic.
        message: its type, as ``sensor_msgs.msg:JointState``.
        kind: ``STATE``, ``CAMERA``, ``DEPTH`` or ``AUXILIARY``.
        depth: how many messages are kept.
        expected_hz: messages a second that should come; None: as many as are sent.
        camera: size of the images, for ``camera`` and ``depth``.
        required: whether ``connect`` waits for it; only auxiliary streams need not be. Otherwise it
            warns if nobody publishes it. Once a message arrived, more must come in either case.
        latched: a topic with ``transient_local`` durability (``latched`` in ROS 1), whose last
            message is sent to late subscribers too. It is published when something changes, so
            silence is no error.
        unheard: likely cause if the stream is silent, for the error message.
    """

    name: str
    topic: str
    message: str
    kind: str = STATE
    depth: int = _STATE_DEPTH
    expected_hz: float | None = None
    camera: Camera | None = None
    required: bool = True
    latched: bool = False
    unheard: str = ""

    @property
    def label(self) -> str:
        """Name and topic, for messages."""
        return f"{self.name} ({self.topic})"


def depth_stream(camera: str) -> str:
    """The name of the stream of a camera's depth images."""
    return f"{camera}_depth"


def camera_stream(
    camera: Camera, topic: str, expected_hz: float | None = None, depth: bool = False
) -> StreamSpec:
    """The stream of a camera's images; of its depth (named ``<camera>_depth``) if ``depth``.

    A topic that ends in ``/compressed`` or ``/compressedDepth`` carries ``CompressedImage``, as
    image_transport names them.
    """
    packed = topic.rstrip("/").rpartition("/")[2] in ("compressed", "compressedDepth")
    return StreamSpec(
        name=depth_stream(camera.name) if depth else camera.name,
        topic=topic,
        message=COMPRESSED_IMAGE if packed else IMAGE,
        kind=DEPTH if depth else CAMERA,
        depth=_IMAGE_DEPTH,
        expected_hz=expected_hz,
        camera=camera,
    )


@dataclass(frozen=True)
class CommandSpec:
    """One publisher.

    Args:
        topic: the topic.
        message: its type, as ``sensor_msgs.msg:JointState``.
        exclusive: whether nobody else may publish there, and somebody must listen.
    """

    topic: str
    message: str = JOINT_STATE
    exclusive: bool = True


@dataclass(frozen=True)
class Received:
    """One message.

    ``receipt`` is seconds on this process's monotonic clock; ``stamp`` seconds on the sender's
    clock, None if the message has none.
    """

    receipt: float
    stamp: float | None
    message: Any

    @cached_property
    def delay_s(self) -> float | None:
        """Seconds from stamp to receipt, each on its own clock; None without a stamp."""
        return None if self.stamp is None else self.receipt - self.stamp


class Ring:
    """At most ``depth`` messages, oldest dropped first, in the order of the sender's stamps.

    A message that another overtook, or that comes twice, says nothing new; it is counted and
    dropped, so that a driver repeating its last image counts as silent. When the sender's clock
    steps (a restart, NTP, a simulation that begins again), what came before the step is dropped,
    because it cannot be compared with what comes after. Any thread may call anything.
    """

    def __init__(self, depth: int) -> None:
        if depth < 1:
            raise ValueError(f"a ring holds at least 1 message, got depth {depth}")
        self._items: deque[Received] = deque(maxlen=depth)
        self._lock = threading.Lock()
        self._before: tuple[float, float | None] = (0.0, None)
        self.received = 0
        self.duplicates = 0
        self.overtaken = 0
        self.clock_steps = 0
        self.stepped_at: float | None = None

    def add(self, receipt: float, stamp: float | None, message: Any) -> bool:
        """Store the message if it is new; returns whether it is."""
        with self._lock:
            self.received += 1
            before, self._before = self._before, (receipt, stamp)
            newest = self._items[-1].stamp if self._items else None
            if stamp is not None and newest is not None and before[1] is not None:
                if stamp in (newest, before[1]):
                    self.duplicates += 1
                    return False
                # A gap in the stream moves both clocks alike and is no step.
                if abs((stamp - before[1]) - (receipt - before[0])) > STEP:
                    self.clock_steps += 1
                    self.stepped_at = receipt
                    self._items.clear()
                elif stamp < newest:
                    self.overtaken += 1
                    return False
            self._items.append(Received(receipt, stamp, message))
            return True

    def newest(self) -> Received | None:
        """The newest message, None before the first."""
        with self._lock:
            return self._items[-1] if self._items else None

    def items(self) -> tuple[Received, ...]:
        """All messages, newest last."""
        with self._lock:
            return tuple(self._items)

    def last(self, count: int) -> tuple[Received, ...]:
        """The last ``count`` messages, or as many as there are, newest last."""
        with self._lock:
            items = self._items
            return tuple(items[index] for index in range(-min(count, len(items)), 0))


class Stream:
    """Messages of one topic; made by ``Connection.subscribe``.

    The callback stores and does nothing else, so that one thread serves every stream. Reliability
    is chosen by what publishers offer, and again when that changes (a driver that starts later, or
    comes back with other settings).
    """

    def __init__(
        self,
        node: Any,
        name: str,
        topic: str,
        message: Any,
        depth: int,
        latched: bool = False,
    ) -> None:
        self.name = name
        self.topic = topic
        self.message = message
        self.ring = Ring(depth)
        self.lost = 0
        self.reliability = ""
        self.from_fast_dds = False
        self.other_vendors: list[str] = []
        self._lock = threading.Lock()
        self._asked: tuple[str, bool] | None = None
        self._node = node
        self._latched = latched
        self._depth = max(depth, _QUEUE)
        self._subscription: Any = None
        self.refresh()

    @property
    def label(self) -> str:
        """Name and topic, for messages."""
        return f"{self.name} ({self.topic})"

    def newest(self) -> Received | None:
        """The newest message, None before the first."""
        return self.ring.newest()

    def refresh(self) -> None:
        """Subscribe once there is a publisher, and again when publishers offer something else."""
        with self._lock:
            offers = self._node.get_publishers_info_by_topic(self.topic)
            wanted = qos.reliability(offers), self._latched and qos.keeps_last(offers)
            self.from_fast_dds = qos.from_fast_dds(offers)
            self.other_vendors = qos.other_vendors(offers)
            if not offers or wanted == self._asked:
                return
            before, self._asked = self._subscription, wanted
            self.reliability = wanted[0]
            self._subscription = self._subscribe(*wanted)
            if before is not None:
                self._node.destroy_subscription(before)

    def _store(self, message: Any) -> None:
        self.ring.add(time.monotonic(), stamp_of(message), message)

    def _count_lost(self, event: Any) -> None:
        self.lost += event.total_count_change

    def _subscribe(self, reliability: str, latched: bool) -> Any:
        def subscribe(**options: Any) -> Any:
            profile = qos.profile(reliability, self._depth, latched)
            return self._node.create_subscription(
                self.message, self.topic, self._store, profile, **options
            )

        events, unsupported = _lost_events(self._count_lost)
        try:
            return subscribe(event_callbacks=events)
        except unsupported:
            # Not every middleware reports losses; then only an expected rate can show a loss.
            return subscribe()


def _lost_events(callback: Callable[[Any], None]) -> tuple[Any, type[Exception]]:
    try:
        from rclpy.event_handler import SubscriptionEventCallbacks, UnsupportedEventTypeError
    except ImportError:  # Humble has them in another module
        from rclpy.qos_event import SubscriptionEventCallbacks, UnsupportedEventTypeError
    return SubscriptionEventCallbacks(message_lost=callback), UnsupportedEventTypeError
