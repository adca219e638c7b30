"""A scene behind a robot's topics, in real time or in a stated share of it.

The calling thread steps the physics on absolute deadlines and publishes the robot's state; a second
one draws the cameras (:mod:`fluxvla_sim.ros2.cameras`) from a copy of the positions, so that a slow
renderer makes images rarer and nothing else late. Three topics are the simulation's own:
``/sim/reset`` (``std_msgs/Int64``: a seed), ``/sim/fault`` (``std_msgs/String``: as ``--fault``
takes it, or ``STREAM=well``) and ``/sim/facts`` (``std_msgs/String``: JSON, ten times a simulated
second and whenever an episode begins or a task is done). A robot may have more, for what a person
sets on it.

A machine that cannot draw and think in real time is given a ``real_time_factor``: the whole robot
then lives that much slower, its rates with it, and the control loop follows the same slowed clock
(:mod:`fluxvla_sim.ros2.operators`). What was promised and not kept is counted: ``late`` periods.
"""

from __future__ import annotations

import json
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from fluxvla_mujoco import divergence

from fluxvla_core.commands import Reporter
from fluxvla_core.errors import FluxError
from fluxvla_core.evaluation import Diverged
from fluxvla_core.ros2 import (
    IMAGE,
    BadMessage,
    Connection,
    Fault,
    Faults,
    Outbox,
    message_class,
    qos,
)
from fluxvla_sim.ros2.cameras import Cameras
from fluxvla_sim.ros2.drivers import Driver
from fluxvla_sim.ros2.settings import NodeSettings, check_fault, depths
from fluxvla_sim.world import CONTROL_HZ, SUBSTEPS, Scene, SimWorld

_FACTS_EVERY = 5
# Simulated seconds after a reset in which no command is taken.
_SETTLE_S = 0.1
# A process that was stopped for longer than this continues from now, instead of catching up.
_FAR_BEHIND_S = 0.5
_WELL = "well"
# Commands that may wait while this process is kept from running: a UR ignores what comes after a
# gap, and a simulation's stall is not the commander's.
_WAITING = 200


@dataclass
class Counts:
    """Counters for the summary at the end; ``late`` counts parts of periods."""

    periods: int = 0
    late: int = 0
    images: int = 0
    commands: int = 0
    refused: dict[str, int] = field(default_factory=dict)


class Judge:
    """Keeps the facts of each episode, and judges every task of the world.

    An episode's steps begin with its first command, as in an evaluation: until then nothing can
    have been done. After the world's ``max_steps`` its outcome is settled.
    """

    def __init__(self, world: SimWorld) -> None:
        self._world = world
        self._facts = world.begin()
        self._seed = 0
        self._resets = 0

    def reset(self, seed: int) -> None:
        """An episode begins."""
        self._facts = self._world.begin()
        self._seed = seed
        self._resets += 1

    def after(self, scene: Scene) -> None:
        """One more control period has passed since the first command."""
        if self._facts.steps < self._world.max_steps:
            self._facts = self._facts.after(scene)

    def facts(self) -> dict[str, Any]:
        """JSON values: ``seed``, ``resets`` (how many episodes began), ``steps`` and ``tasks``:
        name -> ``instruction``, ``success``, ``done``."""
        tasks = {
            task.name: {
                "instruction": task.instruction,
                "success": task.success(self._facts),
                "done": task.done(self._facts) or self._facts.steps >= self._world.max_steps,
            }
            for task in self._world.tasks
        }
        steps = self._facts.steps
        return {"seed": self._seed, "resets": self._resets, "steps": steps, "tasks": tasks}


class RobotNode:
    """Opens the connection at once; ``run`` simulates; ``close`` ends both.

    Args:
        driver: the robot's side of its topics.
        scene: the physics.
        judge: of the scene's world.

    Raises:
        LoadFailed: there is no ROS 2 here.
    """

    def __init__(
        self,
        driver: Driver,
        scene: Scene,
        settings: NodeSettings,
        reporter: Reporter,
        judge: Judge,
    ) -> None:
        self.counts = Counts()
        self._driver, self._scene, self._settings = driver, scene, settings
        self._reporter, self._judge = reporter, judge
        self._faults = Faults()
        # The scene's data, the driver's target and what is set by topics.
        self._lock = threading.Lock()
        # Set by ``stop``. An event has a lock, which the interrupted thread may hold in a handler.
        self._stop_wanted = False
        self._stopping = threading.Event()
        self._commanded = False
        self._parts = 0
        self._published: dict[str, Any] = {}
        self._connection = Connection(f"sim_{settings.name}", settings.domain_id)
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
            RunFailed: nothing can be drawn, or the simulation diverged.
        """
        cameras = Cameras(
            self._scene.model,
            self._image_publishers,
            tuple(self._driver.cameras),
            self._settings,
            self._faults,
            self._look,
            self._stopping,
        )
        cameras.start()
        try:
            self._live(seconds, cameras)
        finally:
            self._stopping.set()
            cameras.join()
            self.counts.images = cameras.sent

    def stop(self) -> None:
        """Let ``run`` return; from any thread or signal handler."""
        self._stop_wanted = True

    def close(self) -> None:
        """Leave the graph; any number of times."""
        self.stop()
        self._connection.close()

    def _live(self, seconds: float | None, cameras: Cameras) -> None:
        outbox, settings = Outbox(self._faults), self._settings
        part = 1.0 / (CONTROL_HZ * settings.parts * settings.real_time_factor)
        pending = sorted(self._settings.faults, key=lambda item: item[0])
        start = deadline = time.monotonic()
        while not self._stop_wanted:
            now = time.monotonic()
            if seconds is not None and now - start >= seconds:
                return
            self._connection.check()
            cameras.check()
            while pending and now - start >= pending[0][0]:
                _, stream, fault = pending.pop(0)
                self._faults.set(stream, fault)
            self._part(outbox, now)
            outbox.flush(time.monotonic())
            deadline += part
            behind = time.monotonic() - deadline
            if behind > 0:
                self.counts.late += 1
                deadline += behind if behind > _FAR_BEHIND_S else 0.0
            else:
                time.sleep(-behind)

    def _part(self, outbox: Outbox, now: float) -> None:
        parts = self._settings.parts
        self._parts += 1
        whole = self._parts % parts == 0
        with self._lock:
            simulated = self._simulated(now)
            self._scene.advance(self._driver.target(simulated), SUBSTEPS // parts)
            why = divergence(self._scene.data)
            if why is not None:  # a robot that jumps home by itself is none
                raise Diverged(f"the simulation diverged: {why}")
            if whole and self._commanded:
                self._judge.after(self._scene)
            due = self._settings.states_by(self._parts) > self._settings.states_by(self._parts - 1)
            messages = self._driver.messages(self._scene.state, simulated) if due else {}
            # Within the lock, so that no state of before a reset is stamped after it.
            stamp = self._now().to_msg()
        for stream, message in messages.items():
            if stream in self._publishers:
                if hasattr(message, "header"):
                    message.header.stamp = stamp
                sent = now + self._settings.latency_s(stream)
                outbox.put(stream, self._publishers[stream], message, sent)
        if whole:
            self.counts.periods += 1
            self._publish_facts()

    def _publish_facts(self) -> None:
        with self._lock:
            facts, reset_at = self._judge.facts(), self._reset_at
        news = any(facts[key] != self._published.get(key) for key in ("resets", "tasks"))
        if news or self.counts.periods % _FACTS_EVERY == 0:
            self._published = facts
            facts = {
                **facts,
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
        connection, driver = self._connection, self._driver
        self._string = message_class("std_msgs.msg:String")
        self._publishers = {
            stream: connection.publisher(topic, message_class(message), depth=5)
            for stream, (topic, message) in driver.states.items()
        }
        offered = qos.BEST_EFFORT if self._settings.best_effort else qos.RELIABLE
        self._image_publishers = {
            stream: connection.publisher(topic, message_class(IMAGE), offered, depth=2)
            for stream, topic in {**driver.cameras, **depths(driver)}.items()
        }
        messages = driver.messages(self._scene.state, self._simulated(time.monotonic()))
        for stream, (topic, message) in driver.latched.items():
            publisher = connection.publisher(topic, message_class(message), latched=True)
            publisher.publish(messages[stream])
        self._facts_publisher = connection.publisher("/sim/facts", self._string)
        for topic, message in {**driver.commands, **driver.knobs}.items():
            self._subscribe(topic, message, self._receiver(topic))
        self._subscribe("/sim/reset", "std_msgs.msg:Int64", lambda m: self._reset(int(m.data)))
        self._subscribe("/sim/fault", "std_msgs.msg:String", lambda m: self._set_fault(m.data))

    def _subscribe(self, topic: str, message: str, callback: Callable[[Any], None]) -> None:
        profile = qos.profile(qos.RELIABLE, _WAITING)
        self._connection.node.create_subscription(message_class(message), topic, callback, profile)

    def _receiver(self, topic: str) -> Callable[[Any], None]:
        def receive(message: Any) -> None:
            now = self._simulated(time.monotonic())
            try:
                with self._lock:
                    if self._is_late(message, now):
                        return
                    self._driver.receive(topic, message, now)
                    self._commanded |= topic in self._driver.commands
            except BadMessage as error:
                # What a driver does with nonsense: nothing.
                refused = self.counts.refused
                refused[error.what] = refused.get(error.what, 0) + 1
                if refused[error.what] == 1:
                    self._reporter.warn(error.what)
                return
            self.counts.commands += 1

        return receive

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
            self._driver.reset(self._scene.state)
            self._judge.reset(max(seed, 0))
            self._reset_at = self._now().nanoseconds
            self._commanded = False

    def _set_fault(self, text: str) -> None:
        stream, _, mode = text.partition("=")
        if mode == _WELL:
            self._faults.clear(stream)
            return
        try:
            stream, fault = Fault.parse(text)
            check_fault(self._driver, stream, fault)
        except FluxError as error:
            self._reporter.warn(str(error))
            return
        self._faults.set(stream, fault)

    def _look(self, data: Any) -> Any:
        """Fill ``data`` with the scene's positions; their stamp."""
        with self._lock:
            data.qpos[:] = self._scene.data.qpos
            return self._now().to_msg()


def simulate(
    driver: Driver,
    world: SimWorld,
    settings: NodeSettings,
    reporter: Reporter,
    render: str = "cheap",
    seconds: float | None = None,
) -> None:
    """A robot in a world until Ctrl-C or SIGTERM, or for ``seconds``; says what it does.

    Args:
        render: quality of the images, see ``fluxvla_mujoco.drawing``.

    Raises:
        As ``RobotNode`` and its ``run``.
    """
    scene = world.open_scene(render)
    node = RobotNode(driver, scene, settings, reporter, Judge(world))
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: node.stop())
    try:
        topics = [topic for topic, _ in driver.states.values()]
        reporter.info(
            f"simulating {settings.name} at {settings.real_time_factor:g} of real time: "
            f"{', '.join([*topics, *driver.cameras.values()])}; "
            f"commands on {', '.join(driver.commands)}; Ctrl-C ends"
        )
        node.run(seconds)
    finally:
        node.close()
        scene.close()
        counts = node.counts
        reporter.info(
            f"{counts.periods} periods ({counts.late} late), {counts.images} images, "
            f"{counts.commands} commands"
        )
