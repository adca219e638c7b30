"""One subscription that fits itself to its publishers and keeps the newest messages."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from fluxvla_core.ros2 import qos
from fluxvla_core.ros2.ring import Received, Ring, stamp_of

# Messages that wait in the middleware while the ROS thread is busy elsewhere.
_QUEUE = 10


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
        """Subscribe once there is a publisher, and anew when publishers offer something else."""
        with self._lock:
            offers = self._node.get_publishers_info_by_topic(self.topic)
            wanted = qos.reliability(offers), self._latched and qos.keeps_last(offers)
            self.from_fast_dds = qos.from_fast_dds(offers)
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
            # Not every middleware tells; then only an expected rate can show a loss.
            return subscribe()


def _lost_events(callback: Callable[[Any], None]) -> tuple[Any, type[Exception]]:
    try:
        from rclpy.event_handler import SubscriptionEventCallbacks, UnsupportedEventTypeError
    except ImportError:  # Humble has them in another module
        from rclpy.qos_event import SubscriptionEventCallbacks, UnsupportedEventTypeError
    return SubscriptionEventCallbacks(message_lost=callback), UnsupportedEventTypeError
