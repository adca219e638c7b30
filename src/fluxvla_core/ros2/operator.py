"""``RosOperator``: base class of ROS 2 operators; a subclass declares streams and commands.

A subclass has ``embodiment``, lists its ``streams()`` and ``commands()``, makes a state vector of
messages in ``read_state`` and messages of an action in ``publish_action``. Everything else is here:
connecting and its checks, matching images and state in time, refusing bad actions before any I/O,
holding on ``stop``, and noticing a driver that falls silent or another node that commands the arm;
and dividing the robot between two processes, with a node in each.
"""

from __future__ import annotations

import itertools
import logging
import threading
import warnings
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.frame import STATE as STATE_STREAM
from fluxvla_core.contracts.frame import RobotFrame
from fluxvla_core.contracts.robot import Operator, Part
from fluxvla_core.errors import ConfigError, Faulted, FluxError, NotReady
from fluxvla_core.ros2 import discovery
from fluxvla_core.ros2.connection import Connection
from fluxvla_core.ros2.startup import StartupChecks, open_topics, wait_for_reading
from fluxvla_core.ros2.stop_motion import Motion, attempt, checked_action, wait_for_receipt
from fluxvla_core.ros2.stream_reader import StreamReader, TimedImages
from fluxvla_core.ros2.streams import (
    CAMERA,
    DEPTH,
    STATE,
    CommandSpec,
    Received,
    Stream,
    StreamSpec,
)
from fluxvla_core.spec import EmbodimentSpec

Array = npt.NDArray[np.float64]
log = logging.getLogger("fluxvla.ros2")

# Ends the names of the nodes, so that people who look at the graph know which is which.
_NODE = {Part.WHOLE: "", Part.WITHOUT_CAMERAS: "_control", Part.WITHOUT_COMMANDS: "_cameras"}
# What subclasses may override, under the names that it had.
_RENAMED = {"pictures_after": "images_after", "admit": "check_command"}


class RosOperator(Operator):
    """One robot on ROS 2 topics.

    Args:
        domain_id: the ROS domain; None takes ``ROS_DOMAIN_ID``.
        connect_timeout_s: how long ``connect`` waits for drivers to be there and to send.
        max_age_s: how long a stream may be silent, checked at every command. Not
            ``safety.max_age_s``: how old an observation may be when the policy is queried.
        max_skew_s: how far the messages of one frame may be apart, by ``sync_on``. Not
            ``safety.max_skew_s``: how far the receipt times of an observation may be apart.
        sync_on: ``stamp`` compares the senders' clocks, ``receipt`` when messages arrived.
        rate_window_s: for how long ``connect`` counts what arrives; 0 does not count.
    """

    api: ClassVar[str] = "1.0"
    embodiment: EmbodimentSpec
    domain_id: int | None

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
        self.domain_id = domain_id
        self.connect_timeout_s = connect_timeout_s
        self.max_age_s = max_age_s
        self.max_skew_s = max_skew_s
        for name in ("connect_timeout_s", "max_age_s", "max_skew_s"):
            if not 0 < getattr(self, name) < float("inf"):
                said = f"{name} must be a positive number of seconds, got {getattr(self, name)!r}"
                raise ConfigError(said)
        self.sync_on = sync_on
        self.rate_window_s = rate_window_s
        # Re-entrant: a signal handler may call stop() in the thread that is sending.
        self._lock = threading.RLock()
        self._opening = threading.Lock()
        self._connection: Connection | None = None
        self._part = Part.WHOLE
        self._specs: tuple[StreamSpec, ...] = ()
        self._publishers: dict[str, Any] = {}
        # What holds the arm, and whether it was sent by ``send_action`` since the last stop.
        self._last: Array | None = None
        self._moving = False
        self._motion = Motion()
        self._fault: FluxError | None = None

    # Methods that a subclass implements or overrides.

    @abstractmethod
    def streams(self) -> Sequence[StreamSpec]:
        """Everything of the whole robot that is subscribed to; a part leaves out what it lacks."""

    @abstractmethod
    def commands(self) -> Sequence[CommandSpec]:
        """Everything of the whole robot that is published; a part leaves out what it lacks."""

    @abstractmethod
    def read_state(self, messages: Mapping[str, Any]) -> Array:
        """``(state_dim,)`` of the newest message of each ``state`` stream; raises Faulted."""

    @abstractmethod
    def publish_action(self, action: Array) -> None:
        """Send a ``(dim,)`` action that was checked, with :meth:`publish`."""

    def read_base(self, messages: Mapping[str, Any]) -> Array | None:
        """``(2,)`` speeds of a mobile base of the auxiliary streams' messages; None without one.

        Raises:
            Faulted: a speed is not finite.
        """
        return None

    def on_connected(self, connection: Connection) -> None:
        """Called at the end of ``connect``; in the part without commands it is not."""
        return

    def on_stop(self) -> None:
        """Called in every ``stop``, once the arm brakes: stop what else can move."""
        return

    def check_command(self, action: Array) -> None:
        """Called before each command is published, after its own checks; does nothing here.

        Raises:
            Faulted: the robot does not take commands now (protective stop, wrong mode).
            Rejected: the robot would not take this one.
        """
        return

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        for old, name in _RENAMED.items():
            if old in vars(cls) and name not in vars(cls):
                message = f"{cls.__name__}.{old} is deprecated, name it {name}"
                warnings.warn(message, DeprecationWarning, stacklevel=2)
                setattr(cls, name, vars(cls)[old])

    # Methods of the Operator contract.

    def without_cameras(self) -> RosOperator | None:
        """This operator, to be connected without a subscription to any camera.

        Raises:
            Rejected: it is connected, or was made the other part.
        """
        return self._divided(Part.WITHOUT_CAMERAS)

    def without_commands(self) -> RosOperator | None:
        """This operator, to be connected without any publisher, and without ``on_connected``.

        Raises:
            Rejected: it is connected, or was made the other part.
        """
        return self._divided(Part.WITHOUT_COMMANDS)

    def connect(self) -> None:
        """Open the connection and wait until the robot is there; nothing if it is open.

        A part of the robot waits for what it has itself.

        Raises:
            LoadFailed: no ROS 2, or a message package is missing.
            NotReady: a topic has no publisher (names those that are there), has another type,
                stays silent, or loses most messages; nobody listens for commands.
            Rejected: another node publishes commands.
            Faulted: what arrives is not what the embodiment describes.
        """
        # Its own lock: stop() must never wait for a driver that does not come.
        with self._opening:
            if self._connection is not None:
                return
            self._fault, self._last, self._moving = None, None, False
            name = f"fluxvla_{self.embodiment.name}{_NODE[self._part]}"
            # A process that commands an arm is not to wait for another one's locks.
            connection = Connection(name, self.domain_id, small=not self._part.cameras)
            try:
                self._subscribe_all(connection)
                self._connection = connection
                read = self.get_frame if self._part.cameras else self.get_state
                wait_for_reading(read, self.connect_timeout_s)
                # It may send something, a command that switches the motors on for one.
                if self._part.commands:
                    self.on_connected(connection)
            except BaseException:
                self._connection = None
                connection.close()
                raise

    def get_frame(self) -> RobotFrame:
        """State and images that belong together, in fresh arrays, with their receipt stamps.

        Waits up to ``max_age_s`` for messages that belong together; as a rule they are there.

        Raises:
            NotReady: not connected, or the part without cameras.
            Stale: a stream is silent or late, or they are too far apart in time.
            BadMessage: a message is not what the embodiment describes.
            Faulted: the connection broke.
        """
        reader = self._reader
        self._part.check_cameras(self.embodiment.name)
        matched = reader.matched()
        states = {spec.name: matched[spec.name] for spec in self._specs if spec.kind == STATE}
        state, stamp = self._state_of(states)
        stamps = {name: found.receipt for name, found in matched.items() if name not in states}
        colours, depths = reader.frame_images(matched)
        newest = {name: received.message for name, received in reader.newest().items()}
        return RobotFrame(
            state, colours, {**stamps, STATE_STREAM: stamp}, depths, self.read_base(newest)
        )

    def get_state(self) -> Array:
        """The newest ``(state_dim,)`` state, without waiting, and without converting images.

        Called after every command, it is also what notices a silent camera between two frames.

        Raises:
            NotReady: not connected.
            Stale: a stream is silent, or the parts of the state are too far apart in time.
            BadMessage: the joint states are not what the embodiment describes.
            Faulted: the connection broke.
        """
        reader = self._reader
        reader.newest()
        reader.check_states_together()
        return self._state_of(reader.states())[0]

    def state_stamp(self) -> float:
        """Receipt of the oldest message that :meth:`get_state` reads now, on the monotonic clock.

        Raises:
            NotReady: not connected.
        """
        return min(received.receipt for received in self._reader.states().values())

    def images_after(self, camera: str, after: float) -> TimedImages:
        """Images that a camera sent after a time, for recordings; any thread may call it.

        Args:
            after: receipt time; earlier images are left out, and all but the newest few.

        Returns:
            Receipt times and ``(H, W, 3)`` uint8 RGB images, oldest first; and how many arrived
            since connecting.

        Raises:
            BadMessage: an image has another size or encoding than its camera.
        """
        if self._connection is None:
            return [], 0
        return self._stream_reader.images_after(camera, after)

    def pictures_after(self, camera: str, after: float) -> TimedImages:
        """Deprecated name of :meth:`images_after`."""
        warnings.warn("pictures_after is deprecated, use images_after", DeprecationWarning, 2)
        return RosOperator.images_after(self, camera, after)

    def send_action(self, action: npt.ArrayLike) -> None:
        """Publish one ``(dim,)`` command.

        Raises:
            Rejected: wrong shape, not finite, or outside the limits; before anything is sent. Or
                this is the part without commands.
            NotReady: not connected.
            Faulted: the connection broke, another node commands the arm, or the robot cannot move.
        """
        self._part.check_commands(self.embodiment.name)
        checked = checked_action(self.embodiment, action)
        with self._lock:
            self._connected().check()
            if self._fault is not None:
                raise self._fault
            self.check_command(checked)
            self.publish_action(checked)
            self._motion.sent(checked)
            self._last, self._moving = checked, True

    def stop(self) -> None:
        """Hold: come to rest, and lead a joint that was kept from following to where it is.

        All within the limits; an arm at rest that follows is sent its last command again. Any
        state, any thread, any number of times. An arm that was not commanded since the last stop,
        or that another node commands, is left alone: it may be elsewhere by now. So is every arm by
        the part without commands. What fails is logged, not raised: the caller is ending a motion
        for another reason.
        """
        with self._lock:
            if self._connection is None or not self._part.commands:
                return
            commands, self._moving = self._stop_commands(), False
            if commands:
                self._motion.wait(self.embodiment)
                self._hold(commands[0])
            attempt(self.embodiment.name, self.on_stop)
        for before, command in itertools.pairwise(commands):
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
                wait_for_receipt(self._publishers)
        finally:
            self._connection = None
            # Without the lock: the ROS thread may wait for it, and close waits for the thread.
            connection.close()

    # For subclasses.

    def publish(self, topic: str, message: Any) -> None:
        """Send a message on one of the ``commands()`` topics; stamps its header if it has one.

        Raises:
            Rejected: this is the part without commands.
            Faulted: the middleware does not take it.
        """
        self._part.check_commands(self.embodiment.name)
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

    def history(self, name: str) -> tuple[Received, ...]:
        """The last messages of a stream, at most its ``depth``, newest last; none without a
        connection, and of a camera in the part without cameras."""
        stream = self._stream(name)
        return stream.ring.items() if stream is not None else ()

    def kept(self, name: str) -> tuple[Received, ...]:
        """Deprecated name of :meth:`history`."""
        warnings.warn("RosOperator.kept is deprecated, use history", DeprecationWarning, 2)
        return self.history(name)

    def newest(self, name: str) -> Received | None:
        """The newest message of a stream, None before the first, without a connection, and of a
        camera in the part without cameras."""
        stream = self._stream(name)
        return stream.newest() if stream is not None else None

    # Private methods.

    def _divided(self, part: Part) -> RosOperator:
        # Itself, not a copy: what a subclass made in its constructor may refer to this object.
        connected = self._connection is not None
        self._part = self._part.divided(part, connected, self.embodiment.name)
        return self

    def _stream(self, name: str) -> Stream | None:
        connection = self._connection
        if connection is None:
            return None
        # Only a part may lack a stream; any other name that is not there is a mistake.
        streams = connection.streams
        return streams[name] if self._part is Part.WHOLE else streams.get(name)

    def _subscribe_all(self, connection: Connection) -> None:
        cameras = () if self._part.cameras else (CAMERA, DEPTH)
        self._specs = tuple(spec for spec in self.streams() if spec.kind not in cameras)
        commands = tuple(self.commands()) if self._part.commands else ()
        self._stream_reader = StreamReader(
            connection, self._specs, self.max_age_s, self.max_skew_s, self.sync_on
        )
        self._publishers = open_topics(connection, self._specs, commands)
        startup = StartupChecks(connection, self._specs, commands, self._publishers)
        startup.run(self.connect_timeout_s, self.rate_window_s)
        if not self._part.commands:
            return
        exclusive = [command.topic for command in commands if command.exclusive]
        connection.watch(lambda: self._watch_commanders(connection, exclusive))

    def _watch_commanders(self, connection: Connection, topics: Sequence[str]) -> None:
        others = discovery.commanders(connection.node, topics, connection.name)
        if not others:
            self._fault = None
            return
        error = discovery.contested(others)
        # While the arm is commanded, the refusal of the next command reports it.
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

    @property
    def _reader(self) -> StreamReader:
        """Reader of the streams; raises NotReady without a connection."""
        self._connected()
        return self._stream_reader

    def _state_of(self, messages: Mapping[str, Received]) -> tuple[Array, float]:
        """The ``(state_dim,)`` state, and the receipt of the oldest message in it."""
        state = self.read_state({name: found.message for name, found in messages.items()})
        return state, min(found.receipt for found in messages.values())

    def _stop_commands(self) -> list[Array]:
        """The commands of a stop; none for an arm that rests, or is somebody else's."""
        if not self._moving or self._last is None:
            return []
        try:
            reader = self._reader
            reader.newest()
            measured = self._state_of(reader.states(-1)), self._state_of(reader.states(-2))
        except FluxError:
            measured = None  # Its last command is where it goes or stays.
        return self._motion.stop_commands(self.embodiment, self._last, measured)

    def _hold(self, command: Array) -> bool:
        self._last = command
        return attempt(self.embodiment.name, lambda: self.publish_action(command))
