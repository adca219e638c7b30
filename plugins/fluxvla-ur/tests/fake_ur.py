"""A fake UR controller for ``ur-rtde``'s own client, in a process of its own, on loopback only.

It speaks as much as that client asks for: RTDE (Universal Robots' "Real-Time Data Exchange" guide;
packages V, v, O, I, S, P and U), the dashboard's lines, the port that takes
the control script, and the Robotiq URCap's lines. The script itself is not run: what it does with
the input registers is modelled (joints that follow ``servoj`` at a limited speed, ``servoStop``,
the watchdog). No forces, no kinematics, no blending.

    with FakeUR() as robot:
        URRTDEOperator(robot.ip)
        robot.tell(safety_mode=3)          # a protective stop
        robot.ask()["q"]

``ur-rtde``'s ports are fixed, so each fake has an address of its own in 127.0.0.0/8.
"""

from __future__ import annotations

import json
import os
import re
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

PORTS = {"rtde": 30004, "dashboard": 29999, "gripper": 63352}
SCRIPT_PORTS = (30001, 30002, 30003)
HOME = (0.0, -1.57, 1.57, -1.57, -1.57, 0.0)
CYCLE_S = 0.008
# RTDE type and ``struct`` format of the variables, by pattern; the guide has the whole table.
VARIABLES = [
    (r"(actual|target)_(q|qd|qdd|current|moment|TCP_\w+)|joint_\w+|\w*wrench|\w*torque", "6d"),
    (r"(in|out)put_double_register_\d+|timestamp|speed_scaling|target_speed_fraction", "d"),
    (r"(speed_slider_fraction|external_force|payload|tcp_force_scalar)", "d"),
    (r"(in|out)put_int_register_\d+|robot_mode|safety_mode|safety_status", "i"),
    (r"runtime_state|robot_status_bits|safety_status_bits|speed_slider_mask", "I"),
    (r"\w+_bit_registers\w*", "I"),
    (r"(standard|configurable|tool)_\w+", "B"),
]
TYPES = {"6d": "VECTOR6D", "d": "DOUBLE", "i": "INT32", "I": "UINT32", "B": "UINT8"}
# Commands of the control script, by the number in ``input_int_register_0``.
SERVO_J, SERVO_STOP, WATCHDOG, STOP_SCRIPT = 11, 16, 35, 255
READY, DONE = 1, 2


class FakeUR:
    """The process, from outside; a context manager.

    Args:
        **facts: what it starts with; see ``Controller.facts``.
    """

    def __init__(self, **facts: Any) -> None:
        self.ip = f"127.{os.getpid() % 250 + 2}.{time.monotonic_ns() % 250}.7"
        self._process = subprocess.Popen(
            [sys.executable, __file__, self.ip, json.dumps(facts)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.ask()

    def tell(self, **facts: Any) -> None:
        """Change what it says about itself."""
        self._order({"facts": facts})

    def ask(self) -> dict[str, Any]:
        """``q``, ``running``, ``servo``: ``[monotonic, q, time, lookahead, gain]`` of each command,
        ``stops``: decelerations, ``watchdog_hz``, ``ended``: why, ``gripper``: what was asked."""
        return self._order({})

    def kill(self) -> None:
        """End it with SIGKILL."""
        self._process.kill()
        self._process.wait(10.0)

    def __enter__(self) -> FakeUR:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """End it, and its pipes."""
        self.kill()
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            pipe.close()

    def _order(self, order: dict[str, Any]) -> dict[str, Any]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(order) + "\n")
        self._process.stdin.flush()
        answer: dict[str, Any] = json.loads(self._process.stdout.readline())
        return answer


def layout(name: str) -> str:
    """``struct`` format of a variable, empty if it is not known."""
    return next((f for pattern, f in VARIABLES if re.fullmatch(pattern, name)), "")


class Controller:
    """Joints, the control script's part, and what is said about them."""

    def __init__(self, facts: dict[str, Any]) -> None:
        self.lock = threading.RLock()
        self.facts: dict[str, Any] = {
            "safety_mode": 1,
            "target_speed_fraction": 1.0,
            "speed_scaling": 1.0,
            # Whether it goes on sending what it sent, like a controller that hangs.
            "frozen": False,
            "remote": True,
            "speed": 3.1,
            "gripper_status": 3,
            "gripper_fault": 0,
            # What the watchdog forgives on top, of machines that run tests and stall.
            "slack_s": 30.0,
            **facts,
        }
        self.q, self.target = list(HOME), list(HOME)
        self.running, self.busy, self.ended = False, False, ""
        self.inputs: dict[str, Any] = {}
        self.answer = 0
        self.watchdog_hz, self.heard = 0.0, time.monotonic()
        self.servo: list[list[Any]] = []
        self.stops: list[float] = []
        self.gripper = {"POS": 0, "GTO": 1, "SPE": 255, "FOR": 255}
        self.asked: list[str] = []

    def cycle(self) -> None:
        with self.lock:
            if self.facts["safety_mode"] != 1:
                self.end("stopped")
            if self.running:
                self._script()
            most = self.facts["speed"] * CYCLE_S * self.facts["target_speed_fraction"]
            steps = [min(max(t - p, -most), most) for t, p in zip(self.target, self.q, strict=True)]
            self.q = [p + step for p, step in zip(self.q, steps, strict=True)]

    def start(self) -> None:
        with self.lock:
            self.running, self.busy, self.answer = self.facts["safety_mode"] == 1, False, 0
            self.watchdog_hz, self.ended = 0.0, ""

    def end(self, why: str) -> None:
        if self.running:
            self.running, self.target, self.ended = False, list(self.q), why

    def _script(self) -> None:
        late = time.monotonic() - self.heard
        if self.watchdog_hz and late > 1.0 / self.watchdog_hz + self.facts["slack_s"]:
            self.end("watchdog")
            return
        command = self.inputs.get("input_int_register_0", 0)
        doubles = [self.inputs.get(f"input_double_register_{n}", 0.0) for n in range(11)]
        if command in (0, SERVO_J):
            self.busy, self.answer = False, READY
            if command == SERVO_J:
                self._servo(doubles)
        elif not self.busy:
            self.busy, self.answer = True, DONE
            if command == SERVO_STOP:
                self.target = list(self.q)
                self.stops.append(doubles[0])
            elif command == WATCHDOG:
                self.watchdog_hz, self.heard = doubles[0], time.monotonic()
            elif command == STOP_SCRIPT:
                self.end("stop script")

    def _servo(self, doubles: list[float]) -> None:
        said = [doubles[:6], *doubles[8:11]]
        if not self.servo or self.servo[-1][1:] != said:
            self.servo.append([time.monotonic(), *said])
        self.target = doubles[:6]

    def value(self, name: str) -> bytes:
        mode = self.facts["safety_mode"]
        number = re.fullmatch(r"output_int_register_(\d+)", name)
        known: dict[str, Any] = {
            "timestamp": time.monotonic(),
            "actual_q": self.q,
            "target_q": self.target,
            "robot_mode": 7,
            "safety_mode": mode,
            "safety_status": mode,
            # Bit 0: normal; 2: protective stop; 7: any emergency stop.
            "safety_status_bits": {1: 1, 3: 4}.get(mode, 128),
            "runtime_state": 2 if self.running else 1,
            "robot_status_bits": 1 | 2 * self.running,
            "target_speed_fraction": self.facts["target_speed_fraction"],
            "speed_scaling": self.facts["speed_scaling"],
        }
        if number is not None:
            # The client may use the upper half of the registers.
            known[name] = self.answer if int(number[1]) in (0, 24) else 1
        form = layout(name)
        found = known.get(name, [0] * 6 if form == "6d" else 0)
        return struct.pack(">" + form, *(found if isinstance(found, list) else [found]))

    def grip(self, line: str) -> str:
        words = line.split()
        with self.lock:
            if words[:1] == ["GET"]:
                special = {
                    "STA": self.facts["gripper_status"],
                    "FLT": self.facts["gripper_fault"],
                }
                return f"{words[1]} {special.get(words[1], self.gripper.get(words[1], 0))}"
            self.asked.append(line)
            registers = dict(zip(words[1::2], map(int, words[2::2]), strict=True))
            if registers.pop("ACT", 0):
                self.facts["gripper_status"] = 3
            self.gripper.update(registers)
            return "ack"


class Server:
    """Its sockets."""

    def __init__(self, ip: str, controller: Controller) -> None:
        self.controller = controller
        serve: list[tuple[int, Callable[[socket.socket], None]]] = [
            (PORTS["rtde"], self.rtde),
            (PORTS["dashboard"], self.dashboard),
            (PORTS["gripper"], self.gripper),
            *((port, self.script) for port in SCRIPT_PORTS),
        ]
        for port, handler in serve:
            listener = socket.create_server((ip, port))
            self.spawn(self.accept, listener, handler)

    def spawn(self, function: Callable[..., None], *arguments: Any) -> None:
        threading.Thread(target=function, args=arguments, daemon=True).start()

    def accept(self, listener: socket.socket, handler: Callable[[socket.socket], None]) -> None:
        while True:
            client, _ = listener.accept()
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.spawn(self.guarded, handler, client)

    def guarded(self, handler: Callable[[socket.socket], None], client: socket.socket) -> None:
        try:
            handler(client)
        except OSError:
            client.close()

    def rtde(self, client: socket.socket) -> None:
        outputs: list[str] = []
        inputs: list[list[str]] = []
        sending = threading.Lock()
        started = threading.Event()
        stream = client.makefile("rb")
        frequency = 500.0

        def send(kind: bytes, payload: bytes) -> None:
            with sending:
                client.sendall(struct.pack(">Hc", len(payload) + 3, kind) + payload)

        def emit(_: socket.socket) -> None:
            payload = b""
            while True:
                started.wait()
                time.sleep(1.0 / frequency)
                with self.controller.lock:
                    if not self.controller.facts["frozen"]:
                        payload = b"\x01" + b"".join(self.controller.value(n) for n in outputs)
                send(b"U", payload)

        while len(head := stream.read(3)) == 3:
            size, kind = struct.unpack(">Hc", head)
            payload = stream.read(size - 3)
            if kind == b"V":  # protocol version, accepted
                send(b"V", b"\x01")
            elif kind == b"v":  # controller version
                send(b"v", struct.pack(">4I", 5, 11, 1, 108318))
            elif kind == b"O":  # outputs: frequency, then names
                (frequency,) = struct.unpack(">d", payload[:8])
                outputs[:] = _names(payload[8:])
                send(b"O", b"\x01" + _types(outputs))
                self.spawn(self.guarded, emit, client)
            elif kind == b"I":  # inputs: names
                inputs.append(_names(payload))
                send(b"I", bytes([len(inputs)]) + _types(inputs[-1]))
            elif kind in (b"S", b"P"):
                (started.set if kind == b"S" else started.clear)()
                send(kind, b"\x01")
            elif kind == b"U":
                self.take(inputs[payload[0] - 1], payload[1:])

    def take(self, names: list[str], payload: bytes) -> None:
        values = struct.unpack(">" + "".join(layout(name) for name in names), payload)
        with self.controller.lock:
            self.controller.inputs.update(zip(names, values, strict=True))
            if any(re.fullmatch(r"input_int_register_(0|24)", name) for name in names):
                self.controller.heard = time.monotonic()

    def dashboard(self, client: socket.socket) -> None:
        client.sendall(b"Connected: Universal Robots Dashboard Server\n")
        for line in client.makefile():
            facts = self.controller.facts
            answer = {
                "PolyscopeVersion": "URSoftware 5.11.1.108318 (Nov 23 2021)",
                "is in remote control": str(facts["remote"]).lower(),
                "get serial number": "20205500000",
                "get robot model": "UR5",
                "robotmode": "Robotmode: RUNNING",
                "safetystatus": "Safetystatus: NORMAL",
                "running": f"Program running: {str(self.controller.running).lower()}",
            }.get(line.strip(), "ok")
            client.sendall(answer.encode() + b"\n")

    def script(self, client: socket.socket) -> None:
        program = b""
        while part := client.recv(65536):
            program += part
            if program.rstrip().endswith(b"end"):
                self.controller.start()
                program = b""

    def gripper(self, client: socket.socket) -> None:
        for line in client.makefile():
            client.sendall(self.controller.grip(line.strip()).encode() + b"\n")


def _names(payload: bytes) -> list[str]:
    # The client's lists end with a comma.
    return [name for name in payload.decode().split(",") if name]


def _types(names: list[str]) -> bytes:
    return ",".join(TYPES.get(layout(name), "NOT_FOUND") for name in names).encode()


def run(ip: str, facts: dict[str, Any]) -> None:
    """Be the controller until standard input ends."""
    controller = Controller(facts)
    server = Server(ip, controller)

    def cycles() -> None:
        due = time.monotonic()
        while True:
            due = max(due + CYCLE_S, time.monotonic() - 0.1)
            controller.cycle()
            time.sleep(max(0.0, due - time.monotonic()))

    server.spawn(cycles)
    for line in sys.stdin:
        order = json.loads(line)
        with controller.lock:
            controller.facts.update(order.get("facts", {}))
            fields = ("q", "running", "servo", "stops", "watchdog_hz", "ended")
            state = {name: getattr(controller, name) for name in fields}
            print(json.dumps({**state, "gripper": controller.asked}), flush=True)


if __name__ == "__main__":
    run(sys.argv[1], json.loads(sys.argv[2]))
