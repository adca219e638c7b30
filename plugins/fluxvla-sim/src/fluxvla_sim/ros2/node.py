"""A scene behind a robot's topics, in real time or in a stated share of it.

The calling thread steps the physics on absolute deadlines and publishes the robot's state; a second
one draws the cameras, each at its own time, from a copy of the positions, so that a slow
renderer makes pictures rarer and nothing else late. Three topics are the simulation's own:
``/sim/reset`` (``std_msgs/Int64``: a seed), ``/sim/fault`` (``std_msgs/String``: as ``--fault``
takes it, or ``STREAM=well``) and ``/sim/facts`` (``std_msgs/String``: JSON, ten times a simulated
second and whenever an episode begins or a task is done).

A machine that cannot draw and think in real time is given a ``real_time_factor``: the whole robot
then lives that much slower, its rates with it, and whoever drives it follows the same slowed clock
(:mod:`fluxvla_sim.ros2.operators`). What was promised and not kept is counted: ``late`` periods.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from fluxvla_core.contracts.reporter import Reporter
from fluxvla_core.errors import ConfigError, FluxError, UsageError
from fluxvla_core.ros2 import images, qos
from fluxvla_core.ros2.connection import Connection
from fluxvla_core.ros2.faults import Fault, Faults, Outbox
from fluxvla_core.ros2.require import message_class
from fluxvla_core.ros2.streams import FLOAT64, IMAGE
from fluxvla_core.ros2.trouble import BadMessage
from fluxvla_sim.render import Renderer, import_mujoco
from fluxvla_sim.ros2.bodies import Body
from fluxvla_sim.ros2.judge import Judge
from fluxvla_sim.world import CONTROL_HZ, Scene

_FACTS_EVERY = 5
# Simulated seconds after a reset in which no command is taken.
_SETTLE_S = 0.1
# A process that was stopped for longer than this goes on from now, instead of catching up.
_FAR_BEHIND_S = 0.5
_WELL = "well"


@dataclass(frozen=True)
class NodeSettings:
    """How a simulated robot presents itself.

    Args:
        name: of the node.
        seed: of the first scene.
        real_time_factor: simulated seconds in a second.
        camera_hz: pictures a simulated second of each camera, if the machine can; a camera that
            nobody listens to is not drawn.
        height, width: of every picture, in pixels.
        best_effort: offer pictures as camera drivers do by default, not reliably.
        faults: (seconds after the start, stream, fault), what falls ill by itself.
        domain_id: the ROS domain; None takes ``ROS_DOMAIN_ID``.
    """

    name: str
    seed: int = 0
    real_time_factor: float = 1.0
    camera_hz: float = 30.0
    height: int = 480
    width: int = 640
    best_effort: bool = False
    faults: Sequence[tuple[float, str, Fault]] = ()
    domain_id: int | None = None

    def __post_init__(self) -> None:
        if not 0 < self.real_time_factor <= 1:
            raise ConfigError(
                f"the real-time factor must be above 0 and at most 1, got {self.real_time_factor:g}"
            )
        if not 0 < self.camera_hz <= 1000:
            raise ConfigError(f"cameras need a rate from 0 to 1000 Hz, got {self.camera_hz:g}")


@dataclass
class Counts:
    """What was done, for the line at the end."""

    periods: int = 0
    late: int = 0
    pictures: int = 0
    commands: int = 0
    refused: dict[str, int] = field(default_factory=dict)


class RobotNode:
    """Opens the connection at once; ``run`` simulates; ``close`` ends both.

    Args:
        body: the robot's side of its topics.
        scene: the physics.
        judge: of the scene's world.

    Raises:
        LoadFailed: there is no ROS 2 here.
    """

    def __init__(
        self,
        body: Body,
        scene: Scene,
        settings: NodeSettings,
        reporter: Reporter,
        judge: Judge,
    ) -> None:
        self.counts = Counts()
        self._body, self._scene, self._settings = body, scene, settings
        self._reporter, self._judge = reporter, judge
        self._faults = Faults()
        # The scene's data, the body's target and what is set by topics.
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._commanded = False
        self._told: dict[str, Any] = {}
        self._connection = Connection(settings.name, settings.domain_id)
        try:
            self._reset(settings.seed)
            self._open()
        except BaseException:
            self._connection.close()
            raise

    def run(self, seconds: float | None = None) -> None:
        """Simulate until ``stop``, or for ``seconds``.

        Raises:
            Faulted: the ROS thread ended.
            RunFailed: nothing can be drawn.
        """
        drawing = _Drawing(self._draw)
        drawing.start()
        try:
            self._live(seconds, drawing)
        finally:
            self._stopping.set()
            drawing.join()

    def stop(self) -> None:
        """Let ``run`` return; from any thread or signal handler."""
        self._stopping.set()

    def close(self) -> None:
        """Leave the graph; any number of times."""
        self.stop()
        self._connection.close()

    def _live(self, seconds: float | None, drawing: _Drawing) -> None:
        outbox = Outbox(self._faults)
        period = 1.0 / (CONTROL_HZ * self._settings.real_time_factor)
        pending = sorted(self._settings.faults, key=lambda item: item[0])
        start = deadline = time.monotonic()
        while not self._stopping.is_set():
            now = time.monotonic()
            if seconds is not None and now - start >= seconds:
                return
            self._connection.check()
            drawing.check()
            while pending and now - start >= pending[0][0]:
                _, stream, fault = pending.pop(0)
                self._faults.set(stream, fault)
            self._period(outbox, now)
            outbox.flush(time.monotonic())
            deadline += period
            behind = time.monotonic() - deadline
            if behind > 0:
                self.counts.late += 1
                deadline += behind if behind > _FAR_BEHIND_S else 0.0
            else:
                self._stopping.wait(-behind)

    def _period(self, outbox: Outbox, now: float) -> None:
        with self._lock:
            self._scene.step(self._body.target(self._simulated(now)))
            state = self._scene.state
            if self._commanded:
                self._judge.after(self._scene)
            told = self._judge.tell()
            # Within the lock, so that no state of before a reset is stamped after it.
            stamp = self._now().to_msg()
            reset_at = self._reset_at
        for stream, message in self._body.say(state).items():
            if stream in self._publishers:
                if hasattr(message, "header"):
                    message.header.stamp = stamp
                outbox.put(stream, self._publishers[stream], message, now)
        self.counts.periods += 1
        news = any(told[key] != self._told.get(key) for key in ("resets", "tasks"))
        if news or self.counts.periods % _FACTS_EVERY == 0:
            self._told = told
            facts = {
                **told,
                "reset_at": reset_at,
                "time": self.counts.periods / CONTROL_HZ,
                "late": self.counts.late,
                "real_time_factor": self._settings.real_time_factor,
            }
            self._facts_publisher.publish(self._string(data=json.dumps(facts)))

    def _simulated(self, now: float) -> float:
        """Simulated seconds: what a trajectory's duration is measured in."""
        return now * self._settings.real_time_factor

    def _now(self) -> Any:
        """The node's clock, which stamps messages: the wall clock, whatever the factor."""
        return self._connection.node.get_clock().now()

    def _open(self) -> None:
        connection, body = self._connection, self._body
        self._string = message_class("std_msgs.msg:String")
        self._publishers = {
            stream: connection.publisher(topic, message_class(message), depth=5)
            for stream, (topic, message) in body.states.items()
        }
        offered = qos.BEST_EFFORT if self._settings.best_effort else qos.RELIABLE
        self._pictures = {
            camera: connection.publisher(topic, message_class(IMAGE), offered, depth=2)
            for camera, topic in body.cameras.items()
        }
        said = body.say(self._scene.state)
        for stream, (topic, message) in body.latched.items():
            profile = qos.profile(qos.RELIABLE, 1, latched=True)
            kept = connection.node.create_publisher(message_class(message), topic, profile)
            kept.publish(said[stream])
        self._facts_publisher = connection.publisher("/sim/facts", self._string)
        for topic, message in body.commands.items():
            self._listen(topic, message, self._hear(topic))
        self._listen("/sim/reset", "std_msgs.msg:Int64", lambda m: self._reset(int(m.data)))
        self._listen("/sim/fault", "std_msgs.msg:String", lambda m: self._ill(m.data))

    def _listen(self, topic: str, message: str, callback: Callable[[Any], None]) -> None:
        profile = qos.profile(qos.RELIABLE, 10)
        self._connection.node.create_subscription(message_class(message), topic, callback, profile)

    def _hear(self, topic: str) -> Callable[[Any], None]:
        def hear(message: Any) -> None:
            now = self._simulated(time.monotonic())
            try:
                with self._lock:
                    if self._is_late(message, now):
                        return
                    self._body.hear(topic, message, now)
                    self._commanded = True
            except BadMessage as error:
                # What a driver does with nonsense: nothing.
                refused = self.counts.refused
                refused[error.what] = refused.get(error.what, 0) + 1
                if refused[error.what] == 1:
                    self._reporter.warn(error.what)
                return
            self.counts.commands += 1

        return hear

    def _is_late(self, message: Any, now: float) -> bool:
        """Whether a command was under way when the episode began: it was for the one before."""
        if now - self._reset_s < _SETTLE_S:
            return True
        stamp = message.header.stamp if hasattr(message, "header") else None
        sent = None if stamp is None else stamp.sec * 10**9 + stamp.nanosec
        # Commands need not be stamped.
        return bool(sent) and sent < self._reset_at

    def _reset(self, seed: int) -> None:
        with self._lock:
            self._reset_s = self._simulated(time.monotonic())
            self._scene.reset(max(seed, 0))
            self._body.reset(self._scene.state)
            self._judge.reset(max(seed, 0))
            self._reset_at = self._now().nanoseconds
            self._commanded = False

    def _ill(self, text: str) -> None:
        stream, _, mode = text.partition("=")
        if mode == _WELL:
            self._faults.clear(stream)
            return
        try:
            stream, fault = Fault.parse(text)
            check_fault(self._body, stream, fault)
        except FluxError as error:
            self._reporter.warn(str(error))
            return
        self._faults.set(stream, fault)

    def _draw(self) -> None:
        mujoco, settings, model = import_mujoco(), self._settings, self._scene.model
        renderer, data = Renderer(model), mujoco.MjData(model)
        outbox = Outbox(self._faults)
        period = 1.0 / (settings.camera_hz * settings.real_time_factor)
        start = time.monotonic()
        cameras = list(self._pictures)
        # Spread over the period, as cameras that nobody synchronised.
        due = {c: start + period * i / len(cameras) for i, c in enumerate(cameras)}
        try:
            while not self._stopping.is_set():
                outbox.flush(time.monotonic())
                camera = min(due, key=due.__getitem__)
                wait = min(due[camera], outbox.next_due) - time.monotonic()
                if wait > 0:
                    self._stopping.wait(wait)
                    continue
                if not self._pictures[camera].get_subscription_count():
                    due[camera] = max(due[camera] + period, time.monotonic())
                    continue
                with self._lock:
                    data.qpos[:] = self._scene.data.qpos
                    stamp = self._now().to_msg()
                # All that a picture needs of the physics, given the positions.
                mujoco.mj_kinematics(model, data)
                mujoco.mj_comPos(model, data)
                mujoco.mj_camlight(model, data)
                pixels = renderer.render(data, camera, settings.height, settings.width)
                message = images.fill(message_class(IMAGE)(), pixels, "rgb8")
                message.header.stamp, message.header.frame_id = stamp, camera
                now = time.monotonic()
                outbox.put(camera, self._pictures[camera], message, now)
                due[camera] = max(due[camera] + period, now)
                self.counts.pictures += 1
        finally:
            renderer.close()


def check_fault(body: Body, stream: str, fault: Fault) -> None:
    """Refuse a fault that a robot's stream cannot have.

    Raises:
        UsageError: there is no such stream (names those that there are), or its messages have
            nothing that could be wrong in this way.
    """
    known = [*body.states, *body.cameras]
    if stream in body.latched:
        raise UsageError(f"{stream} is said once, at the start: it can have no fault")
    if stream not in known:
        raise UsageError(f"the robot has no stream {stream!r}; it has {', '.join(known)}")
    if fault.mode == "nan" and stream in body.cameras:
        raise UsageError(f"{stream} is a camera: a picture's numbers cannot be NaN")
    if fault.mode == "clock" and stream in body.states and body.states[stream][1] == FLOAT64:
        raise UsageError(f"{stream} is a bare number: it bears no stamp that could be wrong")


class _Drawing(threading.Thread):
    """The drawing thread; ``check`` raises what ended it."""

    def __init__(self, draw: Callable[[], None]) -> None:
        super().__init__(name="fluxvla-sim-cameras")
        self._draw = draw
        self._error: BaseException | None = None

    def run(self) -> None:
        try:
            self._draw()
        except BaseException as error:  # noqa: BLE001 - raised again by check
            self._error = error

    def check(self) -> None:
        if self._error is not None:
            raise self._error
