"""A stand-in for a robot's ROS 2 drivers: a process that publishes, subscribes, injects faults.

    python -m fluxvla_core.testing.ros2_driver '{"streams": […], "sinks": […]}'

``Driver`` starts that process from a test, gives it orders and keeps the messages that it received.
It is a process of its own because drivers are: lost images, killed publishers and other settings
after a restart happen between processes only.
Set ``ROS_DOMAIN_ID`` and ``ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST`` before starting one.
"""

from __future__ import annotations

import argparse
import json
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from fluxvla_core.ros2 import Connection, Fault, Faults, Outbox, images, joints, message_class, qos

_START_S = 120.0
_END_S = 5.0


class Driver:
    """The process, from outside; a context manager.

    Args:
        streams: topics that it publishes. Each has ``topic``, ``message`` (type), ``hz``, and by
            type: ``names`` and ``positions`` (JointState), ``height``, ``width`` and ``encoding``
            (Image), ``format`` (CompressedImage: ``jpeg`` or ``png``), ``data`` (std_msgs),
            ``follows`` (a sink's topic: the last command there is where its joints are, in the
            order of ``command_names`` if it has none);
            ``best_effort`` and ``latched`` set its QoS; ``stamped: false`` leaves stamps at zero.
        sinks: topics that it subscribes to: ``topic`` and ``message``. Messages are in ``heard``.
        name: of its node.
        environment: of the process; this one's by default.
    """

    def __init__(
        self,
        streams: Sequence[Mapping[str, Any]] = (),
        sinks: Sequence[Mapping[str, Any]] = (),
        name: str = "driver",
        environment: Mapping[str, str] | None = None,
    ) -> None:
        spec = json.dumps({"streams": list(streams), "sinks": list(sinks), "name": name})
        self.heard: list[dict[str, Any]] = []
        self._ready = threading.Event()
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, spec],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=None if environment is None else dict(environment),
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        if not self._ready.wait(_START_S) or self._process.poll() is not None:
            self.kill()
            raise RuntimeError(
                f"the driver did not start within {_START_S:g} s "
                f"(exit code {self._process.returncode})"
            )

    def tell(self, **order: Any) -> None:
        """``fault="TOPIC=MODE:AMOUNT"``, ``change={topic: {key: value}}``, ``reset=True``: back to
        how it was started, without faults."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(order) + "\n")
        self._process.stdin.flush()

    @property
    def exit_code(self) -> int | None:
        """Exit code of the process; None while it runs."""
        return self._process.poll()

    def kill(self) -> None:
        """End it with SIGKILL: no goodbye on the graph."""
        self._process.kill()
        self._process.wait(_END_S)

    def close(self) -> None:
        """End it by closing its input; it leaves the graph properly."""
        assert self._process.stdin is not None
        if self._process.poll() is None:
            self._process.stdin.close()
            try:
                self._process.wait(_END_S)
            except subprocess.TimeoutExpired:
                self.kill()
        self._reader.join(_END_S)

    def on(self, topic: str) -> list[dict[str, Any]]:
        """Messages on ``topic``, oldest first: ``at`` (monotonic) and the message's fields."""
        return [item for item in list(self.heard) if item["topic"] == topic]

    def __enter__(self) -> Driver:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            item = json.loads(line)
            if "ready" in item:
                self._ready.set()
            else:
                self.heard.append(item)
        self._ready.set()


class _Publisher:
    """One stream of the process."""

    def __init__(self, connection: Connection, spec: dict[str, Any]) -> None:
        self._started = spec
        self.reset()
        self.topic: str = spec["topic"]
        self.cls = message_class(spec["message"])
        kind = qos.BEST_EFFORT if spec.get("best_effort") else qos.RELIABLE
        profile = qos.profile(kind, depth=5, latched=bool(spec.get("latched")))
        self.publisher = connection.node.create_publisher(self.cls, self.topic, profile)
        self.next = time.monotonic()

    def reset(self) -> None:
        self.spec: dict[str, Any] = dict(self._started)

    def make(self, connection: Connection, commands: Mapping[str, Any]) -> Any:
        spec, message, kind = self.spec, self.cls(), self.cls.__name__
        known = commands.get(spec.get("follows", ""))
        if kind == "JointState":
            here = dict(zip(spec["names"], spec["positions"], strict=False))
            if known is not None:
                here.update(_targets(known, spec.get("command_names", spec["names"])))
            spec["positions"] = [here.get(name, 0.0) for name in spec["names"]]
            joints.fill(message, spec["names"], spec["positions"])
        elif kind in ("Image", "CompressedImage"):
            _fill_image(message, spec)
        elif kind == "Odometry":
            message.twist.twist.linear.x, message.twist.twist.angular.z = spec["data"]
        else:
            message.data = spec["data"] if known is None else known.data
        if hasattr(message, "header") and spec.get("stamped", True):
            message.header.stamp = connection.node.get_clock().now().to_msg()
        return message


def _targets(command: Any, names: Sequence[str]) -> dict[str, float]:
    """Joint positions that a JointState, a JointTrajectory's end or an array in order asks for."""
    if hasattr(command, "points"):
        return dict(zip(command.joint_names, command.points[-1].positions, strict=True))
    if hasattr(command, "position"):
        return dict(zip(command.name, command.position, strict=True))
    return dict(zip(names, command.data, strict=False))


def camera_pattern(height: int, width: int, encoding: str) -> np.ndarray[Any, np.dtype[Any]]:
    """The images of the driver's cameras: red 10, green 20, blue 30; depth 1.5 m."""
    if encoding == "16UC1":
        return np.full((height, width), 1500, np.uint16)
    if encoding == "32FC1":
        return np.full((height, width), 1.5, np.float32)
    if encoding == "mono8":
        return np.full((height, width), 40, np.uint8)
    colours = {"r": 10, "g": 20, "b": 30, "a": 255}
    row = [colours[letter] for letter in encoding.rstrip("8")]
    return np.broadcast_to(np.array(row, np.uint8), (height, width, len(row)))


def _fill_image(message: Any, spec: dict[str, Any]) -> None:
    encoding = spec.get("encoding", "rgb8")
    size = spec.get("height", 48), spec.get("width", 64)
    cached = spec.get("cached")
    if cached is None or cached[0] != (size, encoding):
        cached = spec["cached"] = ((size, encoding), camera_pattern(*size, encoding))
    if "format" in spec:
        images.fill_compressed(message, cached[1], encoding, spec["format"])
    else:
        images.fill(message, cached[1], encoding)


def _orders() -> queue.Queue[dict[str, Any] | None]:
    orders: queue.Queue[dict[str, Any] | None] = queue.Queue()

    def read() -> None:
        for line in sys.stdin:
            orders.put(json.loads(line))
        orders.put(None)

    threading.Thread(target=read, daemon=True).start()
    return orders


def _subscribe(
    connection: Connection, sinks: Sequence[Mapping[str, Any]], write: Callable[..., None]
) -> dict[str, Any]:
    commands: dict[str, Any] = {}

    def receiver(topic: str) -> Callable[[Any], None]:
        def store(message: Any) -> None:
            commands[topic] = message
            write(topic=topic, at=time.monotonic(), **_plain(message))

        return store

    for sink in sinks:
        connection.node.create_subscription(
            message_class(sink["message"]), sink["topic"], receiver(sink["topic"]), 50
        )
    return commands


def _plain(message: Any) -> dict[str, Any]:
    """The message's fields as JSON values; headers and empty fields left out."""
    found: dict[str, Any] = {}
    for name in message.get_fields_and_field_types():
        value = getattr(message, name)
        if name == "header" or name == "layout":
            continue
        if hasattr(value, "get_fields_and_field_types"):
            found[name] = _plain(value)
        elif isinstance(value, (str, bool, int, float)):
            found[name] = value
        else:
            found[name] = [
                _plain(v) if hasattr(v, "get_fields_and_field_types") else v for v in value
            ]
    return found


def _order(order: Mapping[str, Any], faults: Faults, publishers: Sequence[_Publisher]) -> None:
    if "fault" in order:
        faults.set(*Fault.parse(order["fault"]))
    if order.get("reset"):
        for publisher in publishers:
            faults.clear(publisher.topic)
            publisher.reset()
    for topic, changes in order.get("change", {}).items():
        for publisher in publishers:
            if publisher.topic == topic:
                publisher.spec.update(changes)


def run(spec: Mapping[str, Any]) -> None:
    """Run the driver until standard input ends."""
    connection = Connection(spec.get("name", "driver"))
    lock = threading.Lock()

    def write(**fields: Any) -> None:
        with lock:
            print(json.dumps(fields), flush=True)

    try:
        commands = _subscribe(connection, spec["sinks"], write)
        publishers = [_Publisher(connection, dict(stream)) for stream in spec["streams"]]
        orders, faults = _orders(), Faults()
        write(ready=True)
        _publish(connection, publishers, commands, orders, faults)
    finally:
        connection.close()


def _publish(
    connection: Connection,
    publishers: Sequence[_Publisher],
    commands: Mapping[str, Any],
    orders: queue.Queue[dict[str, Any] | None],
    faults: Faults,
) -> None:
    outbox = Outbox(faults)
    while True:
        now = time.monotonic()
        for publisher in publishers:
            if now < publisher.next:
                continue
            hz = publisher.spec["hz"]
            # hz 0: once, as a latched topic does.
            publisher.next = max(publisher.next + 1.0 / hz, now - 0.5) if hz else float("inf")
            message = publisher.make(connection, commands)
            outbox.put(publisher.topic, publisher.publisher, message, now)
        outbox.flush(time.monotonic())
        upcoming = [publisher.next for publisher in publishers]
        pause = min([*upcoming, outbox.next_due, now + 0.1]) - time.monotonic()
        try:
            order = orders.get(timeout=max(pause, 0.0))
        except queue.Empty:
            continue
        if order is None:
            return
        if order.get("reset"):
            outbox.clear()
        _order(order, faults, publishers)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="a robot's ROS 2 side, for tests")
    parser.add_argument("spec", type=json.loads)
    run(parser.parse_args().spec)
