"""Benchmarks the latency from a camera to an observation: AlohaOperator and a bare rclpy script.

    python -m benchmarks.ros2_latency [--rounds 4] [--seconds 8]

A driver process publishes three 640x480 rgb8 cameras at 30 Hz and two joint states at 100 Hz. The
two sides take turns, each in a process of its own: the bare script keeps the newest message of each
topic and copies them when asked; the operator matches them in time, checks age, skew, names and
sizes, and then copies them. Both are asked ten times a second. Latency is the time from an image's
stamp to its receipt, and the time that making the observation takes: how long the asker happens to
wait for the next image is not counted. Goal: at most 1.15 times the bare script's. Loopback only.
Writes ``benchmarks/results/ros2_latency.json``.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from fluxvla_aloha.operator import AlohaOperator
from fluxvla_aloha.presets import COBOT_MAGIC

from benchmarks import _results
from fluxvla_core.ros2 import IMAGE, JOINT_STATE
from fluxvla_core.ros2.startup import large_frames_profile
from fluxvla_core.testing.ros2 import claimed_domain
from fluxvla_core.testing.ros2_driver import Driver

GOAL = 1.15
ASKED_HZ = 10.0
# The first answers pay for imports and caches.
WARM_UP = 5


def drive() -> Driver:
    """The robot's side: cameras, joint states, and somebody who hears commands."""
    image = {"message": IMAGE, "hz": 30, "height": 480, "width": 640}
    arm = {"message": JOINT_STATE, "hz": 100, "names": list(COBOT_MAGIC.joints)}
    streams = [{"topic": topic, **image} for topic in COBOT_MAGIC.images]
    streams += [{"topic": t, "positions": [0.0] * 6 + [1.0], **arm} for t in COBOT_MAGIC.states]
    sinks = [{"topic": topic, "message": JOINT_STATE} for topic in COBOT_MAGIC.commands]
    profile = {"FASTDDS_DEFAULT_PROFILES_FILE": large_frames_profile()}
    return Driver(streams, sinks, environment={**os.environ, **profile})


def ask(observe: Callable[[], float], seconds: float) -> dict[str, Any]:
    """Milliseconds that images were under way and that observations took.

    Args:
        observe: makes an observation; gives how long its first image was under way, in seconds.
    """
    receipt, making, until = [], [], time.monotonic() + seconds
    while time.monotonic() < until:
        began = time.perf_counter()
        receipt.append(observe() * 1e3)
        making.append((time.perf_counter() - began) * 1e3)
        time.sleep(1.0 / ASKED_HZ)
    used = resource.getrusage(resource.RUSAGE_SELF)
    kept = {"receipt": receipt[WARM_UP:], "making": making[WARM_UP:]}
    return {**kept, "rss_mb": used.ru_maxrss / 1024}


def seconds_of(stamp: Any) -> float:
    return float(stamp.sec) + stamp.nanosec * 1e-9


def bare(seconds: float) -> dict[str, Any]:
    """What a person would write in an afternoon, and rightly so."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from sensor_msgs.msg import Image, JointState

    rclpy.init()
    node = rclpy.create_node("bare")
    newest: dict[str, Any] = {}
    topics = [(t, Image) for t in COBOT_MAGIC.images] + [
        (t, JointState) for t in COBOT_MAGIC.states
    ]

    def keep(topic: str) -> Callable[[Any], None]:
        return lambda message: newest.__setitem__(topic, (time.time(), message))

    for topic, kind in topics:
        node.create_subscription(kind, topic, keep(topic), 5)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    while len(newest) < len(topics):
        time.sleep(0.01)

    def observe() -> float:
        received = [newest[topic] for topic, _ in topics]
        messages = [message for _, message in received]
        images = [
            np.frombuffer(m.data, np.uint8).reshape(m.height, m.width, 3).copy()
            for m in messages[:3]
        ]
        state = np.concatenate([np.array(m.position) for m in messages[3:]])
        assert len(images) == 3
        assert state.shape == (14,)
        return received[0][0] - seconds_of(messages[0].header.stamp)

    found = ask(observe, seconds)
    executor.shutdown()
    thread.join()
    node.destroy_node()
    rclpy.try_shutdown()
    return found


def operator(seconds: float) -> dict[str, Any]:
    # A busy machine may stall everybody for a while; that is not measured here.
    robot = AlohaOperator(arms="viperx300", max_age_s=5.0, max_skew_s=1.0)
    robot.connect()
    # Receipts are monotonic, stamps are not.
    offset = time.time() - time.monotonic()
    try:

        def observe() -> float:
            before = robot.history("cam_high")
            receipt = robot.get_frame().stamps["cam_high"]
            stamps = {m.receipt: m.stamp for m in (*before, *robot.history("cam_high"))}
            return receipt + offset - (stamps[receipt] or 0.0)

        return ask(observe, seconds)
    finally:
        robot.close()


def side(name: str, seconds: float) -> dict[str, Any]:
    command = [
        sys.executable,
        "-m",
        "benchmarks.ros2_latency",
        "--side",
        name,
        "--seconds",
        str(seconds),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{name} failed with {done.returncode}:\n{done.stderr[-2000:]}")
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def summarise(sides: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    figures: dict[str, Any] = {}
    for name, rounds in sides.items():
        receipt = [value for found in rounds for value in found["receipt"]]
        making = [value for found in rounds for value in found["making"]]
        whole = [a + b for a, b in zip(receipt, making, strict=True)]
        figures[name] = {
            "receipt_p50_ms": round(statistics.median(receipt), 2),
            "making_p50_ms": round(statistics.median(making), 2),
            "p50_ms": round(statistics.median(whole), 2),
            "p95_ms": round(float(np.quantile(whole, 0.95)), 2),
            "rss_mb": round(max(found["rss_mb"] for found in rounds), 1),
            "observations": len(whole),
        }
    ratio = figures["operator"]["p50_ms"] / figures["bare"]["p50_ms"]
    return {**figures, "ratio_p50": round(ratio, 3), "goal": GOAL, "goal_met": ratio <= GOAL}


def main() -> int:
    """Measure, print and write; 0 also when a goal is missed, for a benchmark is not a test."""
    parser = _results.options(__file__)
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--side", choices=("bare", "operator"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    begun = _results.head("fluxvla-aloha", "rclpy")
    if args.side:
        print(json.dumps({"bare": bare, "operator": operator}[args.side](args.seconds)))
        return 0
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    sides: dict[str, list[dict[str, Any]]] = {"bare": [], "operator": []}
    with claimed_domain() as domain:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        with drive():
            for _ in range(args.rounds):
                for name, found in sides.items():
                    found.append(side(name, args.seconds))
    summary = {
        **begun,
        "what": "camera stamp to receipt, plus making an observation of three 640x480 cameras",
        "rounds": args.rounds,
        **summarise(sides),
    }
    _results.keep(args.out, summary)
    return 0


if __name__ == "__main__":
    sys.exit(main())
