"""The faults of docs/safety.md, in its order; see ``_robot_faults`` for how they are played."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._robot_faults import (
    COMMAND,
    GOES_ON,
    NAMES,
    REFUSED,
    SINKS,
    STATE,
    STREAMS,
    Array,
    BenchArm,
    Fault,
    Stage,
)
from fluxvla_core.errors import LoadFailed
from fluxvla_core.ros2 import IMAGE, JOINT_STATE
from fluxvla_core.testing.ros2_driver import Driver

CAM = "/cam/image"
WITHOUT_ROS = """
import sys
sys.modules["rclpy"] = None
from benchmarks._robot_faults import BenchArm
from fluxvla_core.errors import LoadFailed
try:
    BenchArm().connect()
except LoadFailed as error:
    print(error.what, end="")
    sys.exit(error.exit_code)
"""


def ill(*faults: str) -> Callable[[Stage], None]:
    """The driver's streams fall ill, as ``TOPIC=MODE:AMOUNT`` says."""

    def provoke(stage: Stage) -> None:
        for fault in faults:
            stage.robot.tell(fault=fault)

    return provoke


def change(topic: str, **fields: Any) -> Callable[[Stage], None]:
    """The driver sends something else."""
    return lambda stage: stage.robot.tell(change={topic: fields})


def chunk(function: Callable[[Array], Any]) -> Callable[[Stage], None]:
    """The policy's next answers are changed."""
    return lambda stage: stage.spoil(function)


def another_robot(stage: Stage) -> None:
    joints = tuple(replace(j, name=f"left_{j.name}") for j in stage.policy.embodiment.joints)
    stage.policy.embodiment = replace(stage.policy.embodiment, name="other", joints=joints)


def impatient(stage: Stage, operator: BenchArm) -> None:
    stage.operator = operator
    # Fast DDS announces a participant again after 3 s.
    operator.connect_timeout_s = 5.0


def silent_camera(stage: Stage) -> None:
    impatient(stage, stage.operator)
    stage.robot.tell(fault=f"{CAM}=drop")
    time.sleep(0.2)


def without_ros(stage: Stage) -> None:
    words = [sys.executable, "-c", WITHOUT_ROS]
    root = Path(__file__).resolve().parents[1]
    done = subprocess.run(words, capture_output=True, text=True, cwd=root, check=False)
    if done.returncode != LoadFailed("").exit_code:
        raise RuntimeError(done.stderr)
    raise LoadFailed(done.stdout)


def outside(stage: Stage) -> None:
    stage.robot.tell(change={STATE: {"positions": [0.0, 2.5, 0.5], "follows": ""}})
    time.sleep(0.2)


def no_record(stage: Stage) -> None:
    stage.folder.mkdir(parents=True, exist_ok=True)
    (stage.folder / "inference").write_text("not a folder")


def at(row: int, column: int, value: float) -> Callable[[Array], Array]:
    def spoil(actions: Array) -> Array:
        actions[row, column] = value
        return actions

    return spoil


def jump(actions: Array) -> Array:
    # Within the limits at every action, but for a way that nothing explains.
    actions[:, 1] = -2.0
    actions[::2, 1] = 2.0
    return actions


def hasty(actions: Array) -> Array:
    actions[:, 0] = np.where(np.arange(len(actions)) % 4 < 2, -0.4, 0.4)
    return actions


def beyond(actions: Array) -> Array:
    actions[:, 0] = np.linspace(0.9, 1.2, len(actions))
    return actions


def diverge(actions: Array) -> Array:
    raise ValueError("out of memory")


def pause(seconds: float) -> Callable[[Array], Array]:
    def spoil(actions: Array) -> Array:
        time.sleep(seconds)
        return actions

    return spoil


def cable_pulled(stage: Stage) -> None:
    def refuse(action: Array) -> None:
        raise OSError("cable pulled")

    stage.operator.publish_action = refuse  # type: ignore[method-assign]


def stop_raises(stage: Stage) -> None:
    def refuse() -> None:
        del stage.operator.stop
        raise OSError("no answer")

    stage.operator.stop = refuse  # type: ignore[method-assign]
    stage.spoil(diverge)


def signals(*numbers: signal.Signals) -> Callable[[Stage], None]:
    def provoke(stage: Stage) -> None:
        for number in numbers:
            os.kill(os.getpid(), number)
            time.sleep(0.03)

    return provoke


def killed(stage: Stage) -> None:
    stage.robot.kill()


def restarted(stage: Stage) -> None:
    with Driver(STREAMS, SINKS, name="robot"):
        time.sleep(1.0)


def intruder(stage: Stage) -> None:
    there = {"topic": COMMAND, "message": JOINT_STATE, "hz": 50, "names": ["x"], "positions": [1.0]}
    stage.more.append(Driver([there], name="teleop"))


def flood(stage: Stage) -> None:
    noise = {"topic": "/noise", "message": JOINT_STATE, "hz": 1000, "positions": [0.0] * 200}
    streams = [
        {**noise, "names": [f"n{i}" for i in range(200)]},
        {"topic": CAM, "message": IMAGE, "hz": 500, "height": 48, "width": 64},
    ]
    stage.more.append(Driver(streams, name="flood"))


def turned_round(stage: Stage) -> None:
    names = ["finger", *reversed(NAMES)]
    stage.robot.tell(change={STATE: {"names": names, "positions": [9.0, 0.5, 0.0, 0.0]}})
    stage.robot.tell(change={CAM: {"encoding": "bgr8"}})


SILENT = "is silent for"
REFUSALS = [
    Fault(
        "unknown task id",
        lambda stage: setattr(stage, "task", "3"),
        "unknown task '3'; nothing was moved",
        exit_code=2,
    ),
    Fault(
        "instruction misspelt, or none that the config knows",
        lambda stage: setattr(stage, "task", "move the arn"),
        "unknown task 'move the arn'; nothing was moved",
        exit_code=2,
    ),
    Fault("policy for another robot", another_robot, "the policy .* the robot", exit_code=2),
    Fault(
        "start pose beyond a limit",
        lambda stage: stage.arguments.update(prepare_pose=(9.0, 0.0, 0.5)),
        "elbow",
        exit_code=2,
    ),
    Fault("ROS 2 is not installed", without_ros, "rclpy", exit_code=2),
    Fault(
        "wrong domain: nobody publishes",
        lambda stage: impatient(stage, BenchArm(domain_id=stage.empty_domain)),
        r"nobody publishes anything on ROS domain \d+",
    ),
    Fault(
        "topic misspelt",
        lambda stage: impatient(stage, BenchArm(state_topic="/arm/stat")),
        r"/arm/stat\b.*",
    ),
    Fault("a camera never gives an image", silent_camera, r"cam \(/cam/image\)"),
    Fault("joint outside its limits at the start", outside, "wrist is at 2.5, outside its limits"),
    Fault("record cannot be written", no_record, "cannot record the episode"),
]
ROBOT = [
    Fault("camera freezes", ill(f"{CAM}=freeze"), rf"^cam \({CAM}\) {SILENT}", rule="freshness"),
    Fault("camera falls silent", ill(f"{CAM}=drop"), rf"^cam \({CAM}\) {SILENT}", rule="freshness"),
    Fault("camera is late", ill(f"{CAM}=delay:0.7"), r"^cam .*is (late|silent)", rule="freshness"),
    # Whichever rule is there first: the state is too old, or too old for its image.
    Fault(
        "joint states stop",
        ill(f"{STATE}=drop"),
        rf"arm \({STATE}\) {SILENT}|streams cam and state are .* apart",
        rule="freshness",
    ),
    Fault(
        "joint states are NaN",
        ill(f"{STATE}=nan"),
        "position of elbow.* not a finite number",
        rule="frame",
    ),
    Fault(
        "driver killed (SIGKILL), then started again",
        killed,
        SILENT,
        rule="freshness",
        after=restarted,
    ),
    Fault(
        "images of another size",
        change(CAM, height=24, width=32),
        "sends 32x24 images",
        rule="frame",
    ),
    Fault(
        "images without colours",
        change(CAM, encoding="16UC1"),
        "sends 16UC1 images",
        rule="frame",
    ),
    Fault(
        "joint names missing",
        change(STATE, names=list(NAMES[:2]), positions=[0.0, 0.0]),
        "no joint called grip",
        rule="frame",
    ),
    Fault(
        "robot does not follow",
        change(STATE, follows=""),
        "away from its command",
        rule="tracking",
        braked=False,
    ),
    Fault(
        "another node sends commands",
        intruder,
        f"also publishes on {COMMAND}",
        rule="operator",
        braked=False,
    ),
    Fault(
        "operator raises in `send_action`",
        cable_pulled,
        "OSError: cable pulled",
        rule="operator",
    ),
]
POLICY = [
    Fault("NaN in a chunk", chunk(at(3, 1, np.nan)), "not finite: action 3, wrist", rule="chunk"),
    Fault("Inf in a chunk", chunk(at(3, 1, np.inf)), "not finite: action 3, wrist", rule="chunk"),
    Fault("chunk of a wrong shape", chunk(lambda c: c[:, :2]), "chunk has shape", rule="chunk"),
    Fault("chunk that jumps", chunk(jump), "wants wrist to jump", rule="chunk"),
    Fault("chunk far beyond a position limit", chunk(at(4, 0, 9.0)), "far beyond", rule="chunk"),
    Fault("policy raises", chunk(diverge), "the policy raised ValueError", rule="policy"),
    Fault("policy hangs", chunk(pause(6.0)), "waits for a chunk", rule="starvation"),
    Fault(
        "policy slower than its chunks", chunk(pause(1.5)), "waits for a chunk", rule="starvation"
    ),
    Fault("operator's `stop()` raises", stop_raises, "the policy raised", rule="policy"),
]
SIGNALS = [
    Fault("Ctrl-C", signals(signal.SIGINT), "stopped by Ctrl-C", exit_code=130),
    Fault("SIGTERM", signals(signal.SIGTERM), "stopped by SIGTERM"),
    Fault(
        "second Ctrl-C", signals(signal.SIGINT, signal.SIGINT), "stopped by Ctrl-C", exit_code=130
    ),
]
NO_FAULTS = [
    Fault("chunk a little beyond a position limit", chunk(beyond)),
    Fault("chunk faster than the velocity limit", chunk(hasty)),
    Fault("joints in another order or too many, bgr images", turned_round),
    Fault("messages twice, or overtaken", ill(f"{STATE}=out_of_order", f"{CAM}=duplicate")),
    Fault(
        "wall clock stepped",
        ill(*(f"{s['topic']}=clock:-3600" for s in STREAMS)),
    ),
    Fault("network flood", flood),
]
FAULTS = (
    *(replace(fault, outcome=REFUSED) for fault in REFUSALS),
    *ROBOT,
    *POLICY,
    *SIGNALS,
    *(replace(fault, outcome=GOES_ON, exit_code=0) for fault in NO_FAULTS),
)
