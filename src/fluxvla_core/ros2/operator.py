"""The base of ROS 2 operators: a subclass says what is read and written, and what it means.

A subclass has ``embodiment``, lists its ``streams()`` and ``commands()``, makes a state vector of
messages in ``read_state`` and messages of an action in ``publish_action``. Everything else is here:
connecting and its checks, matching pictures and state in time, refusing bad actions before any I/O,
holding on ``stop``, and noticing a driver that falls silent or another node that commands the arm.
"""

from __future__ import annotations

import itertools
import logging
import threading
import time
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.frame import STATE as STATE_STREAM
from fluxvla_core.contracts.robot import Operator
from fluxvla_core.errors import ConfigError, Faulted, FluxError, NotReady
from fluxvla_core.ros2 import discovery, frames, silence, sync
from fluxvla_core.ros2.actions import checked_action
from fluxvla_core.ros2.connection import Connection
from fluxvla_core.ros2.frames import RobotFrame
from fluxvla_core.ros2.holding import Motion, attempt
from fluxvla_core.ros2.require import message_class
from fluxvla_core.ros2.ring import Received
from fluxvla_core.ros2.startup import Startup
from fluxvla_core.ros2.streams import CAMERA, DEPTH, STATE, CommandSpec, StreamSpec
from fluxvla_core.ros2.trouble import Stale
from fluxvla_core.spec.embodiment import EmbodimentSpec

Array = npt.NDArray[np.float64]
log = logging.getLogger("fluxvla.ros2")

# How often a wait for messages that belong together looks again.
_LOOK_S = 0.002
# How long a last command may take to be acknowledged before the connection is given up.
_FLUSH_S = 0.2


class RosOperator(Operator):
    """One robot on ROS 2 topics.

    Args:
        domain_id: the ROS domain; None takes ``ROS_DOMAIN_ID``.
        connect_timeout_s: how long ``connect`` waits for drivers to be there and to send.
        max_age_s: a stream whose last message arrived longer ago is silent, and no frame is made.
        max_skew_s: how far the messages of one frame may be apart by their stamps.
        sync_on: ``stamp`` compares the senders' clocks, ``receipt`` when messages arrived.
        rate_window_s: for how long ``connect`` counts what arrives; 0 does not count.
    """

    api: ClassVar[str] = "1.0"
    embodiment: EmbodimentSpec

    def __init__(
        self,
        domain_id: int | None = None,
        connect_timeout_s: float = 10.0,
        max_age_s: float = 0.5,
        max_skew_s: float = 0.1,
        sync_on: str = "stamp",
        rate_window_s: float = 1.0,
    ) -> None:
        if sync_on not in ("stamp", "receipt"):
            raise ConfigError(f"sync_on is 'stamp' or 'receipt', got {sync_on!r}")
        bounds = {
            "connect_timeout_s": connect_timeout_s,
            "max_age_s": max_age_s,
            "max_skew_s": max_skew_s,
        }
        for name, value in bounds.items():
            if not 0 < value < float("inf"):
                raise ConfigError(f"{name} must be a positive number of seconds, got {value!r}")
        self.domain_id = domain_id
        self.connect_timeout_s = connect_timeout_s
        self.max_age_s = max_age_s
        self.max_skew_s = max_skew_s
        self.sync_on = sync_on
        self.rate_window_s = rate_window_s
        # Re-entrant: a signal handler may call stop() in the thread that is sending.
        self._lock = threading.RLock()
        self._opening = threading.Lock()
        self._connection: Connection | None = None
        self._specs: tuple[StreamSpec, ...] = ()
        self._publishers: dict[str, Any] = {}
        # What holds the arm, and whether it was sent by ``send_action`` since the last stop.
        self._last: Array | None = None
        self._moving = False
        self._motion = Motion()
        self._fault: FluxError | None = None

    # What a subclass says.

    @abstractmethod
    def streams(self) -> Sequence[StreamSpec]:
        """Everything that is subscribed to."""

    @abstractmethod
    def commands(self) -> Sequence[CommandSpec]:
        """Everything that is published."""

    @abstractmethod
    def read_state(self, messages: Mapping[str, Any]) -> Array:
        """``(state_dim,)`` of the newest message of each ``state`` stream; raises Faulted."""

    @abstractmethod
    def publish_action(self, action: Array) -> None:
        """Send a ``(dim,)`` action that was checked, with :meth:`publish`."""

    def read_base(self, messages: Mapping[str, Any]) -> Array | None:
        """``(2,)`` speeds of a mobile base of the ``side`` streams' messages; None without one.

        Raises:
            Faulted: a speed is not finite.
        """
        return None

    def on_connected(self, connection: Connection) -> None:
        """Called at the end of ``connect``."""
        return

    def on_stop(self) -> None:
        """Called in every ``stop``, once the arm brakes: stop what else can move."""
        return

    def admit(self, action: Array) -> None:
        """Called before each command; raises Faulted where the robot says that it takes none, and
        Rejected where it would not take this one."""
        return

    # The contract.

    def connect(self) -> None:
        """Open the connection and wait until the robot is there; nothing if it is open.

        Raises:
            LoadFailed: no ROS 2, or a message package is missing.
            NotReady: a topic has no publisher (names those that are there), bears another type,
                stays silent, or loses most messages; nobody listens for commands.
            Rejected: another node publishes commands.
            Faulted: what arrives is not what the embodiment describes.
        """
        # Its own lock: stop() must never wait for a driver that does not come.
        with self._opening:
            if self._connection is not None:
                return
            self._fault, self._last, self._moving = None, None, False
            connection = Connection(f"fluxvla_{self.embodiment.name}", self.domain_id)
            try:
                self._subscribe_all(connection)
                self._connection = connection
                self._first_frame()
                self.on_connected(connection)
            except BaseException:
                self._connection = None
                connection.close()
                raise

    def get_frame(self) -> RobotFrame:
        """State and pictures that belong together, in fresh arrays, with their receipt stamps.

        Waits up to ``max_age_s`` for messages that belong together; as a rule they are there.

        Raises:
            NotReady: not connected.
            Stale: a stream is silent or late, or they are too far apart in time.
            BadMessage: a message is not what the embodiment describes.
            Faulted: the connection broke.
        """
        matched = self._matched()
        stamps = {name: received.receipt for name, received in matched.items()}
        states = {spec.name: matched[spec.name].message for spec in self._specs_of(STATE)}
        stamps[STATE_STREAM] = min(stamps.pop(name) for name in states)
        colours, depths = frames.pictures(self._specs, matched)
        newest = {name: received.message for name, received in self._fresh().items()}
        return RobotFrame(self.read_state(states), colours, stamps, depths, self.read_base(newest))

    def get_state(self) -> Array:
        """The newest ``(state_dim,)`` state, without waiting, and without converting pictures.

        Called after every command, it is also what notices a silent camera between two frames.

        Raises:
            NotReady: not connected.
            Stale: a stream is silent, or the parts of the state are too far apart in time.
            BadMessage: the joint states are not what the embodiment describes.
            Faulted: the connection broke.
        """
        self._fresh()
        self._check_together()
        return self._measured()[0]

    def state_stamp(self) -> float:
        """Receipt of the oldest message that :meth:`get_state` reads now, on the monotonic clock.

        Raises:
            NotReady: not connected.
        """
        self._connected()
        newest = [self.newest(spec.name) for spec in self._specs_of(STATE)]
        return min(received.receipt for received in newest if received is not None)

    def pictures_after(
        self, camera: str, after: float
    ) -> tuple[list[tuple[float, npt.NDArray[np.uint8]]], int]:
        """What a camera sent, for those who record more than is looked at; any thread may ask.

        Args:
            after: receipt time; earlier pictures are left out, and all but the newest few.

        Returns:
            Receipt times and ``(H, W, 3)`` uint8 RGB pictures, oldest first; and how many arrived
            since connecting.

        Raises:
            BadMessage: a picture has another size or encoding than its camera.
        """
        connection = self._connection
        specs = [s for s in self._specs_of(CAMERA) if s.camera and s.camera.name == camera]
        if connection is None or not specs:
            return [], 0
        ring = connection.streams[specs[0].name].ring
        new = [received for received in ring.items() if received.receipt > after]
        found = [(r.receipt, frames.pictures(specs, {specs[0].name: r})[0][camera]) for r in new]
        return found, ring.received - ring.duplicates - ring.overtaken

    def send_action(self, action: npt.ArrayLike) -> None:
        """Publish one ``(dim,)`` command.

        Raises:
            Rejected: wrong shape, not finite, or outside the limits; before anything is sent.
            NotReady: not connected.
            Faulted: the connection broke, another node commands the arm, or the robot cannot move.
        """
        checked = checked_action(self.embodiment, action)
        with self._lock:
            connection = self._connected()
            connection.check()
            if self._fault is not None:
                raise self._fault
            self.admit(checked)
            self.publish_action(checked)
            self._motion.sent(checked)
            self._last, self._moving = checked, True

    def stop(self) -> None:
        """Hold: come to rest, and lead a joint that was kept from following to where it is.

        All within the limits; an arm at rest that follows is sent its last command again. Any
        state, any thread, any number of times. An arm that was not commanded since the last stop,
        or that another node commands, is left alone: it may be elsewhere by now. What fails is
        logged, not raised: the caller is ending a motion for another reason.
        """
        with self._lock:
            if self._connection is None:
                return
            way, self._moving = self._way_to_hold(), False
            if way:
                self._motion.wait(self.embodiment)
                self._hold(way[0])
            attempt(self.embodiment.name, self.on_stop)
        for before, command in itertools.pairwise(way):
            self._motion.wait(self.embodiment)
            with self._lock:
                # Closed, or commanded by somebody else meanwhile.
                if self._connection is None or self._last is not before or not self._hold(command):
                    return

    def close(self) -> None:
        """Hold, then give the connection back; any number of times."""
        connection = self._connection
        if connection is None:
            return
        try:
            with self._lock:
                self.stop()
                self._flush()
        finally:
            self._connection = None
            # Without the lock: the ROS thread may wait for it, and close waits for the thread.
            connection.close()

    # For subclasses.

    def publish(self, topic: str, message: Any) -> None:
        """Send a message on one of the ``commands()`` topics; stamps its header if it has one.

        Raises:
            Faulted: the middleware does not take it.
        """
        connection = self._connected()
        if hasattr(message, "header"):
            message.header.stamp = connection.node.get_clock().now().to_msg()
        try:
            self._publishers[topic].publish(message)
        except Exception as error:  # rclpy's own classes differ between releases
            raise Faulted(f"a command on {topic} could not be sent: {error}") from error

    @property
    def last_action(self) -> Array | None:
        """``(dim,)`` the command that holds the arm; None before any, or if another node's does."""
        return None if self._last is None else self._last.copy()

    def kept(self, name: str) -> tuple[Received, ...]:
        """The messages of a stream that are kept, newest last; none without a connection."""
        connection = self._connection
        return connection.streams[name].ring.items() if connection is not None else ()

    def newest(self, name: str) -> Received | None:
        """The newest message of a stream, None before the first or without a connection."""
        connection = self._connection
        return connection.streams[name].newest() if connection is not None else None

    # Parts.

    def _subscribe_all(self, connection: Connection) -> None:
        self._specs = tuple(self.streams())
        commands = tuple(self.commands())
        for spec in self._specs:
            message = message_class(spec.message)
            connection.subscribe(spec.name, spec.topic, message, spec.depth, spec.latched)
        self._publishers = {
            command.topic: connection.publisher(command.topic, message_class(command.message))
            for command in commands
        }
        startup = Startup(connection, self._specs, commands, self._publishers)
        startup.wait(self.connect_timeout_s)
        for warning in [*startup.count(self.rate_window_s), *startup.unheard()]:
            log.warning("%s", warning)
        exclusive = [command.topic for command in commands if command.exclusive]
        connection.watch(lambda: self._watch_commanders(connection, exclusive))

    def _first_frame(self) -> None:
        """See that frames can be made; drivers that only now get going are given time."""
        until = time.monotonic() + self.connect_timeout_s
        while True:
            try:
                self.get_frame()
            except Stale:
                if time.monotonic() >= until:
                    raise
                time.sleep(_LOOK_S)
            else:
                return

    def _watch_commanders(self, connection: Connection, topics: Sequence[str]) -> None:
        others = discovery.commanders(connection.node, topics, connection.name)
        if not others:
            self._fault = None
            return
        error = discovery.contested(others)
        # Whoever commands the arm is told by the refusal of the next command.
        if self._fault is None and not self._moving:
            log.error("%s", error.what)
        with self._lock:
            # The arm has the other's command now: no stop may send it back to ours.
            self._fault = Faulted(error.what, cause=error.cause, next=error.next)
            self._last = None

    def _connected(self) -> Connection:
        if self._connection is None:
            raise NotReady(f"{self.embodiment.name} is not connected", next="call connect() first")
        return self._connection

    def _matched(self) -> Mapping[str, Received]:
        """Messages of state, cameras and depth that belong together, waiting a little for them."""
        connection = self._connected()
        names = [spec.name for spec in self._specs_of(STATE, CAMERA, DEPTH)]
        # A burst puts a stream apart from the others for a moment; one that fell silent is named
        # as such in this time; only a driver that is late stays apart.
        until = time.monotonic() + self.max_age_s
        while True:
            self._fresh()
            by = "receipt" if self._clock_stepped() else self.sync_on
            rings = {name: connection.streams[name].ring.items() for name in names}
            try:
                self._check_together()
                match = sync.match(rings, self.max_skew_s, by, sync.wall())
                sync.check_age(match, time.monotonic(), self.max_age_s)
            except Stale:
                if time.monotonic() >= until:
                    raise
                time.sleep(_LOOK_S)
            else:
                return match.messages

    def _check_together(self) -> None:
        if self.sync_on == "stamp" and not self._clock_stepped():
            streams = self._connected().streams
            parts = {spec.name: streams[spec.name].ring.items() for spec in self._specs_of(STATE)}
            sync.check_together(parts, self.max_skew_s, sync.wall())

    def _specs_of(self, *kinds: str) -> list[StreamSpec]:
        return [spec for spec in self._specs if spec.kind in kinds]

    def _fresh(self) -> dict[str, Received]:
        """The newest message of every stream that has one; none that should speak is silent."""
        connection = self._connected()
        connection.check()
        newest = {spec.name: connection.streams[spec.name].newest() for spec in self._specs}
        watched = {
            spec.name: newest[spec.name]
            for spec in self._specs
            if not spec.latched and (spec.required or newest[spec.name] is not None)
        }
        silent = sync.silent(watched, time.monotonic(), self.max_age_s)
        if silent:
            whole = len(silent) == len(watched)
            raise silence.explained(connection, silent, self.max_age_s, whole)
        return {name: received for name, received in newest.items() if received is not None}

    def _clock_stepped(self) -> bool:
        """Whether a sender's clock stepped so recently that stamps on both sides are kept."""
        connection = self._connected()
        since = time.monotonic() - self.max_age_s
        rings = [stream.ring for stream in connection.streams.values()]
        return any(ring.stepped_at is not None and ring.stepped_at > since for ring in rings)

    def _way_to_hold(self) -> list[Array]:
        """The commands of a stop; none for an arm that rests, or is somebody else's."""
        if not self._moving or self._last is None:
            return []
        try:
            self._fresh()
            measured = (self._measured(-1), self._measured(-2))
        except FluxError:
            measured = None  # Its last command is where it goes or stays.
        return self._motion.way_to_hold(self.embodiment, self._last, measured)

    def _hold(self, command: Array) -> bool:
        self._last = command
        return attempt(self.embodiment.name, lambda: self.publish_action(command))

    def _measured(self, index: int = -1) -> tuple[Array, float]:
        """A ``(state_dim,)`` state that is kept, and the receipt of the oldest message in it.

        Args:
            index: -1 for the newest, -2 for the one before it, or the newest if it is the only one.
        """
        streams = self._connected().streams
        kept = {spec.name: streams[spec.name].ring.items() for spec in self._specs_of(STATE)}
        states = {name: items[max(index, -len(items))] for name, items in kept.items()}
        state = self.read_state({name: found.message for name, found in states.items()})
        return state, min(found.receipt for found in states.values())

    def _flush(self) -> None:
        from rclpy.duration import Duration

        for topic, publisher in self._publishers.items():
            try:
                publisher.wait_for_all_acked(Duration(seconds=_FLUSH_S))
            except Exception as error:  # noqa: BLE001 - a broken publisher has nothing to flush
                log.error("the last message on %s may not have arrived: %s", topic, error)
