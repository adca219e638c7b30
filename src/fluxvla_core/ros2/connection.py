"""One node in one context, spun by one thread, with the shutdown order that works.

A ``MultiThreadedExecutor`` loses messages and burns a core in the rclpy releases that are in use;
one thread that only stores messages keeps up with 240 VGA pictures a second. The context is our
own, so several connections, on several domains, live in one process, and nobody else's
``rclpy.shutdown`` ends this one. rclpy's signal handlers stay out: they invalidate the context
first, and then a last "hold" could not be published any more.
"""

from __future__ import annotations

import os
import re
import secrets
import threading
from collections.abc import Callable
from typing import Any

from fluxvla_core.errors import ConfigError, Faulted
from fluxvla_core.robot.control import priority
from fluxvla_core.ros2 import qos
from fluxvla_core.ros2.memory import keep_large_blocks
from fluxvla_core.ros2.require import require_rclpy
from fluxvla_core.ros2.stream import Stream

WATCH_S = 0.25
"""How often the graph is looked at: publishers that come, go or change what they offer."""
_JOIN_S = 5.0
_MAX_DOMAIN = 232


class Connection:
    """Opens a node at once; ``close`` gives everything back.

    Args:
        name: begins the node's name; process id and a random part make it unique.
        domain_id: the ROS domain; None takes ``ROS_DOMAIN_ID`` (0 without it).

    Raises:
        LoadFailed: there is no rclpy here.
        ConfigError: the domain is no number from 0 to 232.
    """

    def __init__(self, name: str, domain_id: int | None = None) -> None:
        rclpy = require_rclpy()
        _check_domain(domain_id)
        keep_large_blocks()
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.signals import SignalHandlerOptions

        clean = re.sub(r"\W+", "_", name).strip("_") or "node"
        self.name = f"{clean}_{os.getpid()}_{secrets.token_hex(2)}"
        self.failure: BaseException | None = None
        self.streams: dict[str, Stream] = {}
        self._watchers: list[Callable[[], None]] = []
        self._closing = threading.Event()
        self._lock = threading.Lock()
        self._context = Context()
        rclpy.init(
            args=[],
            context=self._context,
            domain_id=domain_id,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        try:
            self.node = rclpy.create_node(
                self.name,
                context=self._context,
                enable_rosout=False,
                start_parameter_services=False,
            )
            self.domain: int = self._context.get_domain_id()
            self._wake = self.node.create_guard_condition(lambda: None)
            self.every(WATCH_S, self._watch)
            self._executor = SingleThreadedExecutor(context=self._context)
            self._executor.add_node(self.node)
        except BaseException:
            self._context.try_shutdown()
            raise
        # Not a daemon: a daemon thread inside rcl at interpreter exit ends in std::terminate.
        self._thread = threading.Thread(target=self._spin, name=self.name)
        self._thread.start()

    def subscribe(
        self, name: str, topic: str, message: Any, depth: int, latched: bool = False
    ) -> Stream:
        """A stream that keeps the last ``depth`` messages of class ``message``."""
        stream = Stream(self.node, name, topic, message, depth, latched)
        self.streams[name] = stream
        return stream

    def publisher(
        self,
        topic: str,
        message: Any,
        reliability: str = qos.RELIABLE,
        depth: int = 1,
        latched: bool = False,
    ) -> Any:
        """A publisher; as it stands fit for commands: RELIABLE matches every subscription, and a
        command that was overtaken by a newer one must never be sent again. What is ``latched`` is
        also told to those who ask for it when they come later."""
        return self.node.create_publisher(message, topic, qos.profile(reliability, depth, latched))

    def every(self, seconds: float, callback: Callable[[], None]) -> Any:
        """Call back from the ROS thread, on the steady clock (wall clocks get stepped)."""
        from rclpy.clock import Clock, ClockType

        clock = Clock(clock_type=ClockType.STEADY_TIME)
        return self.node.create_timer(seconds, callback, clock=clock)

    def watch(self, callback: Callable[[], None]) -> None:
        """Also call ``callback`` whenever the graph is looked at (ROS thread, ``WATCH_S``)."""
        self._watchers.append(callback)

    def check(self) -> None:
        """Nothing, while the connection is open and its thread runs.

        Raises:
            Faulted: it was closed, or a callback ended its thread; carries that error.
        """
        if self.failure is not None:
            raise Faulted(f"the ROS thread of {self.name} ended: {self.failure}") from self.failure
        if self._closing.is_set():
            raise Faulted(f"the connection {self.name} is closed")

    def close(self) -> None:
        """Stop the thread, then destroy node and context; any number of times, from any thread."""
        with self._lock:
            if self._closing.is_set():
                return
            self._closing.set()
        self._wake.trigger()
        if threading.current_thread() is not self._thread:
            self._thread.join(_JOIN_S)

    def _watch(self) -> None:
        for stream in self.streams.copy().values():
            stream.refresh()
        for callback in self._watchers:
            callback()

    def _spin(self) -> None:
        # Whoever sends commands waits for the interpreter while this thread has it.
        priority.just_below_real_time()
        main = threading.main_thread()
        try:
            # The watch timer wakes this at least every WATCH_S, so a main thread that ends without
            # close() is noticed, and the process does not hang on a thread that it must join.
            while not self._closing.is_set() and main.is_alive() and self._context.ok():
                self._executor.spin_once()
        except BaseException as error:  # noqa: BLE001 - kept, and raised to whoever asks next
            self.failure = error
        finally:
            self._closing.set()
            self._executor.shutdown()
            self.node.destroy_node()
            self._context.try_shutdown()


def _check_domain(domain_id: int | None) -> None:
    said: object = domain_id if domain_id is not None else os.environ.get("ROS_DOMAIN_ID") or 0
    try:
        number = int(str(said))
    except ValueError:
        number = -1
    if not 0 <= number <= _MAX_DOMAIN:
        raise ConfigError(f"a ROS domain is a number from 0 to {_MAX_DOMAIN}, got {said!r}")
