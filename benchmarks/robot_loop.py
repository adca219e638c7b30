"""Benchmarks a minute of driving a robot over ROS 2 against the way it was done upstream.

    python -m benchmarks.robot_loop [--seconds 60] [--rounds 1] [--minutes 10]

A driver process publishes three 640x480 rgb8 cameras at 30 Hz and two joint states at 100 Hz; a
torch policy of 10 M parameters thinks all the time, on one core; commands go out at 50 Hz. The
sides take turns, each in a process of its own:

* ``fluxvla``: ``AlohaInferenceRunner`` with ``async_execution`` and every safety rule; a process of
  its own sends the commands.
* ``recording``: the same with ``--record``: everything into a bag, images too.
* ``lock held``: the same with a policy that holds the GIL half of the time.
* ``one process``, also ``recording`` and ``lock held``: with ``control_process=False``.
* ``upstream``: the same policy and topics, driven as FluxVLA's ROS 1 operators and runners do it
  (rewritten for this): callbacks append raw messages to queues of 2000, the loop pops and
  converts what it needs, infers, and sends the chunk's commands itself. Before it starts it waits
  as they wait at their prompt for a task (``--prompt`` seconds), while the queues fill.

* ``rclpy node``: what one Python process takes that only receives these states and sends at 50 Hz,
  without limits or checks, while the policy thinks in another.
* ``bare``: nothing but a loop that wakes at 50 Hz with a real-time priority, where it may have one,
  while the cameras send: what this machine gives to anybody.

Jitter is how far the time between two commands is from 20 ms, at the sender; late is a command more
than 2 ms behind its deadline (upstream: behind the one before it). Memory is the private memory
that the process has more at its most than when it had loaded everything; ``--minutes`` runs our
side for so long and shows whether it grows. Goals, on all three sides with a process of its own:
late < 0.1 %, jitter p99 < 0.3 ms, that process below 90 MB (its proportional memory: what it shares
with the main process counts half) and 10 % of a core; no frame copied more than once; upstream's
jitter p99 at least 5 times, and its memory at least 10 times ours. Loopback only. Writes
``benchmarks/results/robot_loop.json``.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import tracemalloc
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from fluxvla_aloha.operator import AlohaOperator
from fluxvla_aloha.presets import COBOT_MAGIC
from fluxvla_aloha.runner import AlohaInferenceRunner

from benchmarks import _results
from benchmarks._robot_loop_policies import (
    RATE_HZ,
    START_POSE,
    LockHolder,
    TenMillion,
    warm_policy,
)
from benchmarks._timed_arms import TIMES, TimedAloha, memory_mb
from fluxvla_core.build import RunContext
from fluxvla_core.control import realtime
from fluxvla_core.robot.recording.recorded import open_recording
from fluxvla_core.ros2 import IMAGE, JOINT_STATE
from fluxvla_core.ros2.startup import large_frames_profile
from fluxvla_core.testing.ros2 import claimed_domain
from fluxvla_core.testing.ros2_driver import Driver

EXECUTED = 25
LATE_S = 0.002
GOALS = {
    "late_share": 0.001,
    "jitter_p99_ms": 0.3,
    "control_mb": 90.0,
    "control_core_share": 0.1,
    "copies": 1.05,
    "jitter": 5.0,
    "memory": 10.0,
}
OURS = ("fluxvla", "recording", "lock held")
QUEUE = 2000
FRAME_BYTES = 3 * 480 * 640 * 3


class Memory:
    """Private memory of this process and of its control process, looked at twice a second."""

    def __init__(self) -> None:
        self.seen: list[float] = [memory_mb()["private"]]
        self.control: list[float] = []
        self._children: list[int] = []
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()

    def _look(self) -> None:
        while not self._over.wait(0.5):
            self.seen.append(memory_mb()["private"])
            try:
                self.control += [memory_mb(pid)["private"] for pid in self._children]
            except OSError:  # it has ended, as the run soon will
                continue
            self._children = self._children or control_processes()

    def summary(self) -> dict[str, float]:
        """MiB: more at its most than at the start; growth per minute over the last two thirds."""
        self._over.set()
        self._thread.join()
        found = {
            "at_start_mb": round(self.seen[0], 1),
            "more_mb": round(max(self.seen) - self.seen[0], 1),
            "grows_mb_per_minute": per_minute(self.seen),
        }
        if self.control:
            found["control_grows_mb_per_minute"] = per_minute(self.control)
        return found


def per_minute(seen: list[float]) -> float:
    """The slope of the last two thirds of what was seen twice a second."""
    late = np.array(seen[len(seen) // 3 :])
    slope = np.polyfit(np.arange(len(late)), late, 1)[0] * 120 if len(late) > 2 else 0.0
    return round(float(slope), 2)


def control_processes() -> list[int]:
    """The control process of this one, if it has one just now."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            words = (folder / "cmdline").read_bytes().split(b"\0")
            parent = (folder / "stat").read_text(encoding="ascii").rpartition(")")[2].split()[1]
        except OSError:
            continue  # it has ended
        if parent == str(os.getpid()) and b"fluxvla_core.robot.process" in words:
            found.append(int(folder.name))
    return found


def drive() -> Driver:
    """The robot's side: cameras, joint states, and somebody who hears commands."""
    image = {"message": IMAGE, "hz": 30, "height": 480, "width": 640}
    arm = {"message": JOINT_STATE, "hz": 100, "names": list(COBOT_MAGIC.joints)}
    start = [*START_POSE[:6], COBOT_MAGIC.gripper_open]
    streams = [{"topic": topic, **image} for topic in COBOT_MAGIC.images]
    streams += [
        {"topic": state, "positions": start, "follows": command, **arm}
        for state, command in zip(COBOT_MAGIC.states, COBOT_MAGIC.commands, strict=True)
    ]
    sinks = [{"topic": topic, "message": JOINT_STATE} for topic in COBOT_MAGIC.commands]
    profile = {"FASTDDS_DEFAULT_PROFILES_FILE": large_frames_profile()}
    return Driver(streams, sinks, environment={**os.environ, **profile})


def timings(sent: list[float], late: list[float]) -> dict[str, Any]:
    """Milliseconds of jitter, share of late commands."""
    jitter = np.abs(np.diff(sent) - 1 / RATE_HZ) * 1e3
    return {
        "commands": len(sent),
        "jitter_p50_ms": round(float(np.median(jitter)), 3),
        "jitter_p99_ms": round(float(np.quantile(jitter, 0.99)), 3),
        "jitter_max_ms": round(float(jitter.max()), 1),
        "late_share": round(float(np.mean(np.array(late) > LATE_S)), 5),
    }


def figures(sent: list[float], late: list[float], policy: TenMillion) -> dict[str, Any]:
    """Of a side that has a policy."""
    return {
        **timings(sent, late),
        "policy_p50_ms": round(statistics.median(policy.seconds) * 1e3, 1),
        "parameters": policy.parameters,
    }


def fluxvla(
    seconds: float,
    prompt: float,
    record: bool = False,
    kind: type[TenMillion] = TenMillion,
    control_process: bool = True,
) -> dict[str, Any]:
    # A starved machine may silence everybody for a while; that is not measured here.
    patient = {"max_age_s": 10.0, "max_skew_s": 5.0}
    robot = {"arms": "viperx300", "connect_timeout_s": 60.0, **patient}
    policy = warm_policy(kind)
    copies = copies_per_frame(AlohaOperator(**robot))
    memory = Memory()
    with tempfile.TemporaryDirectory() as folder:
        times = Path(folder) / "times.json"
        os.environ[TIMES] = str(times)
        runner = AlohaInferenceRunner(
            context=RunContext(section="inference", work_dir=Path(folder), task="1"),
            operator={"type": TimedAloha.__name__, **robot},
            policy=policy,
            task_descriptions={"1": "swing"},
            async_execution=True,
            max_publish_step=round(seconds * RATE_HZ),
            safety={**patient, "starvation_s": 120.0},
            record_fps=None,
            record=folder if record else None,
            control_process=control_process,
        )
        runner.run_setup()
        runner.run()
        used = memory.summary()
        (summary,) = Path(folder).rglob("episode.json")
        rows = open_recording(summary.parent).of("command")
        found = json.loads(times.read_text(encoding="utf-8"))
    late = [r["ms"]["late"] / 1e3 for r in rows if r["phase"] == "run"]
    sent = found["sent"][: len(late)]
    control = {
        "control_mb": found["mb"]["proportional"],
        "control_private_mb": found["mb"]["private"],
        "control_resident_mb": found["mb"]["resident"],
        "control_core_share": found["core_share"],
    }
    own = control if control_process else {}
    return {**figures(sent, late, policy), "copies": copies, **used, **own}


def copies_per_frame(robot: AlohaOperator) -> float:
    """What ``get_frame`` allocates, in sizes of what it gives; at its most.

    Messages that arrive meanwhile are allocated by the ROS thread; in some calls none does.
    """
    robot.connect()
    robot.get_frame()
    peaks = []
    for _ in range(40):
        tracemalloc.start()
        robot.get_frame()
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        time.sleep(0.005)
    robot.close()
    return round(min(peaks) / FRAME_BYTES, 2)


def upstream(seconds: float, prompt: float) -> dict[str, Any]:
    """What the module's text says; stamps are compared, ages are not, as there."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions
    from sensor_msgs.msg import Image, JointState

    policy = warm_policy()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("upstream")
    topics = [(t, Image) for t in COBOT_MAGIC.images] + [
        (t, JointState) for t in COBOT_MAGIC.states
    ]
    queues: dict[str, deque[Any]] = {topic: deque(maxlen=QUEUE) for topic, _ in topics}
    memory = Memory()
    for topic, kind in topics:
        node.create_subscription(kind, topic, _to(queues[topic]), 1000)
    publishers = [node.create_publisher(JointState, t, 10) for t in COBOT_MAGIC.commands]
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    time.sleep(prompt)
    sent: list[float] = []
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        frame = popped(queues)
        if frame is None:
            time.sleep(0.001)
            continue
        chunk = policy.predict_action(frame)
        for action in chunk[:EXECUTED]:
            began = time.monotonic()
            for index, publisher in enumerate(publishers):
                message = JointState(name=list(COBOT_MAGIC.joints))
                message.header.stamp = node.get_clock().now().to_msg()
                message.position = action[7 * index : 7 * index + 7].tolist()
                publisher.publish(message)
            sent.append(began)
            time.sleep(max(0.0, 1 / RATE_HZ - (time.monotonic() - began)))
    found = memory.summary()
    executor.shutdown()
    thread.join()
    node.destroy_node()
    rclpy.try_shutdown()
    late = list(np.diff(sent) - 1 / RATE_HZ)
    return {**figures(sent, late, policy), **found}


def bare(seconds: float, prompt: float) -> dict[str, Any]:
    """A loop that does nothing; ``late_share`` and jitter as the others have them."""
    woke, late = [], []
    with realtime.real_time():
        due = time.monotonic()
        for _ in range(round(seconds * RATE_HZ)):
            due += 1 / RATE_HZ
            time.sleep(max(0.0, due - time.monotonic()))
            woke.append(time.monotonic())
            late.append(woke[-1] - due)
    return timings(woke, late)


def rclpy_node(seconds: float, prompt: float) -> dict[str, Any]:
    """The share of a core of ``_rclpy_node``, beside a policy that thinks as ``fluxvla``'s does."""
    policy = warm_policy()
    words = ["-m", "benchmarks._rclpy_node", str(seconds)]
    node = subprocess.Popen([sys.executable, *words], stdout=subprocess.PIPE, text=True)
    images = {str(n): np.zeros((480, 640, 3), np.uint8) for n in range(3)}
    while node.poll() is None:
        policy.predict_action({"images": images})
    found, _ = node.communicate()
    if node.returncode:
        sys.exit(f"the rclpy node failed with {node.returncode}")
    return {"core_share": round(float(found), 3)}


def _to(queue: deque[Any]) -> Callable[[Any], None]:
    # rclpy asks for the callback's signature, which a built-in method has not.
    return lambda message: queue.append(message)


def popped(queues: dict[str, deque[Any]]) -> dict[str, Any] | None:
    """Of every queue the first message that is as new as the slowest camera's newest."""

    def stamp(message: Any) -> float:
        return float(message.header.stamp.sec) + message.header.stamp.nanosec * 1e-9

    if not all(queues.values()):
        return None
    instant = min(stamp(queues[topic][-1]) for topic in COBOT_MAGIC.images)
    if any(stamp(queue[-1]) < instant for queue in queues.values()):
        return None
    messages = []
    for queue in queues.values():
        while stamp(queue[0]) < instant:
            queue.popleft()
        messages.append(queue.popleft())
    images = [np.frombuffer(m.data, np.uint8).reshape(m.height, m.width, 3) for m in messages[:3]]
    state = np.concatenate([np.array(m.position) for m in messages[3:]])
    return {"qpos": state, "images": {str(n): p.copy() for n, p in enumerate(images)}}


SIDES: dict[str, Callable[[float, float], dict[str, Any]]] = {
    "fluxvla": fluxvla,
    "recording": partial(fluxvla, record=True),
    "lock held": partial(fluxvla, kind=LockHolder),
    "one process": partial(fluxvla, control_process=False),
    "one process, recording": partial(fluxvla, record=True, control_process=False),
    "one process, lock held": partial(fluxvla, kind=LockHolder, control_process=False),
    "upstream": upstream,
    "rclpy node": rclpy_node,
    "bare": bare,
}


def side(name: str, seconds: float, prompt: float) -> dict[str, Any]:
    words = ["--side", name, "--seconds", str(seconds), "--prompt", str(prompt)]
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.robot_loop", *words],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        sys.exit(f"{name} failed with {done.returncode}:\n{done.stderr[-3000:]}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def summarise(rounds: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """The median round of each side, ratios of medians, and which goals were met."""

    def median(name: str, key: str) -> float:
        return statistics.median(found[key] for found in rounds[name])

    ours, theirs = "fluxvla", "upstream"
    ratios = {
        "jitter": round(median(theirs, "jitter_p99_ms") / median(ours, "jitter_p99_ms"), 2),
        "memory": round(median(theirs, "more_mb") / max(median(ours, "more_mb"), 0.1), 2),
    }
    alone = median("rclpy node", "core_share")
    of_node = {name: round(median(name, "control_core_share") / alone, 2) for name in OURS}
    limits = ("late_share", "jitter_p99_ms", "control_mb", "control_core_share")
    met = {name: all(median(s, name) <= GOALS[name] for s in OURS) for name in limits}
    met["copies"] = median(ours, "copies") <= GOALS["copies"]
    met.update({name: ratio >= GOALS[name] for name, ratio in ratios.items()})
    return {
        **rounds,
        "upstream_over_fluxvla": ratios,
        "control_core_share_over_rclpy_node": of_node,
        "goals": GOALS,
        "goals_met": met,
    }


def main() -> int:
    """Measure, print and write; 0 also when a goal is missed, for a benchmark is not a test."""
    parser = _results.options(__file__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--prompt", type=float, default=20.0, help="seconds before upstream starts")
    parser.add_argument("--minutes", type=float, default=0.0, help="of our side alone, for memory")
    parser.add_argument("--side", choices=SIDES, help=argparse.SUPPRESS)
    args = parser.parse_args()
    begun = _results.head("fluxvla-aloha", "rclpy", "torch")
    if args.side:
        print(json.dumps(SIDES[args.side](args.seconds, args.prompt)))
        return 0
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    rounds: dict[str, list[dict[str, Any]]] = {name: [] for name in SIDES}
    with claimed_domain() as domain:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        with drive():
            for _ in range(args.rounds):
                for name, found in rounds.items():
                    found.append(side(name, args.seconds, args.prompt))
            long = [side("fluxvla", args.minutes * 60, 0.0)] if args.minutes else []
    summary = {
        **begun,
        "what": "50 Hz commands while a torch policy thinks, three 640x480 cameras, two arms",
        "seconds": args.seconds,
        **summarise(rounds),
        **({"minutes": args.minutes, "long": long[0]} if long else {}),
    }
    _results.keep(args.out, summary)
    return 0


if __name__ == "__main__":
    sys.exit(main())
