"""Benchmarks a UR at 125 Hz over ROS 2 on a machine whose processors are all busy.

    python -m benchmarks.ur_rate [--seconds 30]

A driver process publishes joint states at 125 Hz and two small cameras at 30 Hz; a policy swings
the base; commands go out at 125 Hz to the controller of positions. The sides take turns, each in a
process of its own:

* ``busy``: on every processor another process computes all the time, of the same priority.
* ``busy, one process``: the same with ``control_process=False``.
* ``idle``: nothing else runs.

A tick whose command was not sent is skipped; late is a command more than 2 ms behind its deadline.
Goals: with a process of its own under 0.5 % of the ticks skipped, and 15 % of a core (``idle``).
Loopback only. Writes ``benchmarks/results/ur_rate.json``.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from fluxvla_ur.embodiment import JOINTS
from fluxvla_ur.operator import CONTROLLERS, STREAMED

from benchmarks import _results
from benchmarks._timed_arms import TIMES, TimedUR
from benchmarks.robot_loop import LATE_S
from fluxvla_core import BaseInferenceRunner, RunContext
from fluxvla_core.robot.recording.recorded import open_recording
from fluxvla_core.ros2 import FLOAT64, IMAGE, JOINT_STATE
from fluxvla_core.testing.ros2 import claimed_domain
from fluxvla_core.testing.ros2_driver import Driver

RATE_HZ = 125.0
POSE = (0.1, -1.5, 1.4, -1.3, -1.2, 0.2)
GOALS = {"skipped_share": 0.005, "control_core_share": 0.15}
SIDES = {"busy": (True, True), "busy, one process": (True, False), "idle": (False, True)}
BUSY = "while True: pass"


class Swinging:
    """Swings the base gently; thinks in no time."""

    action_rate_hz, horizon = 25.0, 25

    def __init__(self, embodiment: Any) -> None:
        self.embodiment = embodiment

    def reset(self, seed: int) -> None:
        """It has no state."""

    def predict_action(self, observation: Mapping[str, Any]) -> npt.NDArray[np.float64]:
        ahead = time.monotonic() + np.arange(1, self.horizon + 1) / self.action_rate_hz
        chunk = np.tile(np.array([*POSE, 0.5]), (self.horizon, 1))
        chunk[:, 0] += 0.2 * np.sin(ahead)
        return chunk


def drive() -> Driver:
    """The robot's side: its drivers, two cameras, and somebody who hears commands."""
    topic, message = CONTROLLERS[STREAMED]
    arm = {"names": list(JOINTS), "positions": list(POSE), "command_names": list(JOINTS)}
    streams: list[dict[str, Any]] = [
        {"topic": "/joint_states", "message": JOINT_STATE, "hz": RATE_HZ, "follows": topic, **arm},
        {"topic": "/gripper/position", "message": FLOAT64, "hz": 50, "data": 0.5},
    ]
    for camera in ("front", "wrist"):
        image = {"message": IMAGE, "hz": 30, "height": 96, "width": 128}
        streams.append({"topic": f"/{camera}_camera/color/image_raw", **image})
    sinks = [
        {"topic": topic, "message": message},
        {"topic": "/gripper/command", "message": FLOAT64},
    ]
    return Driver(streams, sinks)


@contextmanager
def busy(processors: int) -> Iterator[None]:
    """A process that computes all the time on each of so many processors."""
    running = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(processors)]
    try:
        yield
    finally:
        for process in running:
            process.kill()
            process.wait()


def measured(name: str, seconds: float) -> dict[str, Any]:
    """One side, in this process."""
    loaded, control_process = SIDES[name]
    # A starved machine may silence everybody for a while; that is not measured here.
    patient = {"max_age_s": 10.0, "max_skew_s": 5.0}
    robot = {
        "height": 96,
        "width": 128,
        "controller": STREAMED,
        "rate_window_s": 0.0,
        "require_status": False,
        **patient,
    }
    embodiment = TimedUR(**robot).embodiment
    with (
        tempfile.TemporaryDirectory() as folder,
        busy((os.cpu_count() or 1) if loaded else 0),
    ):
        times = Path(folder) / "times.json"
        os.environ[TIMES] = str(times)
        runner = BaseInferenceRunner(
            context=RunContext(section="inference", work_dir=Path(folder), task="1"),
            operator={"type": TimedUR.__name__, "connect_timeout_s": 60.0, **robot},
            policy=Swinging(embodiment),
            task_descriptions={"1": "swing"},
            async_execution=True,
            max_publish_step=round(seconds * RATE_HZ),
            safety={**patient, "starvation_s": 120.0, "silence_s": 5.0},
            record_fps=None,
            control_process=control_process,
        )
        runner.run_setup()
        runner.run()
        (summary,) = Path(folder).rglob("episode.json")
        recording = open_recording(summary.parent)
        rows = [row for row in recording.of("command") if row["phase"] == "run"]
        (end,) = recording.of("end")
        found = json.loads(times.read_text(encoding="utf-8"))
    ticks = len(rows) + end["skipped_ticks"]
    late = np.array([row["ms"]["late"] for row in rows]) > LATE_S * 1e3
    return {
        "ticks": ticks,
        "skipped": end["skipped_ticks"],
        "skipped_share": round(end["skipped_ticks"] / ticks, 5),
        "late_share": round(float(late.mean()), 5),
        **({"control_core_share": found["core_share"]} if control_process else {}),
    }


def side(name: str, seconds: float) -> dict[str, Any]:
    """One side, in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.ur_rate", "--side", name, "--seconds", str(seconds)],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        sys.exit(f"{name} failed with {done.returncode}:\n{done.stderr[-3000:]}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def main() -> int:
    """Measure, print and write; 0 also when a goal is missed, for a benchmark is not a test."""
    parser = _results.options(__file__)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--side", choices=SIDES, help=argparse.SUPPRESS)
    args = parser.parse_args()
    begun = _results.head("fluxvla-ur", "rclpy")
    if args.side:
        print(json.dumps(measured(args.side, args.seconds)))
        return 0
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    with claimed_domain() as domain:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        found: dict[str, Any] = {}
        for name in SIDES:
            # An arm that begins where its config says, each time.
            with drive():
                found[name] = side(name, args.seconds)
    met = {
        "skipped_share": found["busy"]["skipped_share"] < GOALS["skipped_share"],
        "control_core_share": found["idle"]["control_core_share"] < GOALS["control_core_share"],
    }
    summary = {
        **begun,
        "what": "125 Hz commands to a UR over ROS 2 while every processor is busy",
        "seconds": args.seconds,
        **found,
        "goals": GOALS,
        "goals_met": met,
    }
    _results.keep(args.out, summary)
    return 0


if __name__ == "__main__":
    sys.exit(main())
