"""Everything that goes wrong with a robot, provoked for real, while an arm moves over ROS 2.

``FAULTS`` is the list; docs/safety.md has a row for each. A driver in a process of its own is the
arm and its cameras, a second one only listens: what is judged is what that one received through
DDS. ``Stage.play`` runs the real inference runner in this thread, provokes one fault once the arm
moves, and returns the result.
"""

from __future__ import annotations

import json
import os
import re
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core import BaseInferenceRunner, RunContext
from fluxvla_core.errors import FluxError, NotReady
from fluxvla_core.ros2 import (
    IMAGE,
    JOINT_STATE,
    CommandSpec,
    Connection,
    RosOperator,
    StreamSpec,
    camera_stream,
    joints,
    message_class,
)
from fluxvla_core.spec import Camera, EmbodimentSpec, Joint
from fluxvla_core.testing.ros2 import claimed_domain
from fluxvla_core.testing.ros2_driver import Driver

Array = npt.NDArray[np.float64]
NAMES = ("elbow", "wrist", "grip")
ARM = EmbodimentSpec(
    "bench_arm",
    (
        Joint("elbow", "rad", -1.0, 1.0, 2.0, 10.0),
        Joint("wrist", "rad", -2.0, 2.0, 2.0, 10.0),
        Joint("grip", "normalized", 0.0, 1.0, 2.0, 20.0, kind="gripper", open=1.0, closed=0.0),
    ),
    (Camera("cam", 48, 64), Camera("wrist_cam", 48, 64)),
    50.0,
)
STATE, COMMAND = "/arm/state", "/arm/command"
CAMERAS = tuple(f"/{camera.name}/image" for camera in ARM.cameras)
STREAMS: list[dict[str, Any]] = [
    {
        "topic": STATE,
        "message": JOINT_STATE,
        "hz": 100,
        "names": list(NAMES),
        "positions": [0.0, 0.0, 0.5],
        "follows": COMMAND,
    },
    *({"topic": t, "message": IMAGE, "hz": 30, "height": 48, "width": 64} for t in CAMERAS),
]
SINKS = [{"topic": COMMAND, "message": JOINT_STATE}]
# How many commands are seen before a fault, and after one that must change nothing.
MOVING, GOING_ON = 25, 75
# Slack of what is computed from positions that were sent as doubles.
ROUNDING = 1e-6
STOP, REFUSED, GOES_ON = "stop", "refused", "goes on"


class BenchArm(RosOperator):
    """Three joints and two cameras, with every default of ``RosOperator``."""

    embodiment = ARM

    def __init__(
        self, state_topic: str = STATE, domain_id: int | None = None, **settings: float
    ) -> None:
        super().__init__(domain_id, connect_timeout_s=20.0, rate_window_s=0.0, **settings)
        self.state_topic = state_topic
        self.sent: list[list[float]] = []

    def streams(self) -> list[StreamSpec]:
        cameras = [camera_stream(c, f"/{c.name}/image") for c in self.embodiment.cameras]
        return [StreamSpec("arm", self.state_topic, JOINT_STATE), *cameras]

    def commands(self) -> list[CommandSpec]:
        return [CommandSpec(COMMAND)]

    def read_state(self, messages: Mapping[str, Any]) -> Array:
        names = self.embodiment.joint_names
        return joints.positions(messages["arm"], names, f"arm ({self.state_topic})")

    def on_connected(self, connection: Connection) -> None:
        # The arm and the listener: what is judged is what arrives there, from the first command on.
        (publisher,) = self._publishers.values()
        until = time.monotonic() + 20.0
        while publisher.get_subscription_count() < 2:
            if time.monotonic() > until:
                raise NotReady("the listener does not hear the commands")
            time.sleep(0.01)

    def publish_action(self, action: Array) -> None:
        self.sent.append(action.tolist())
        names = self.embodiment.joint_names
        self.publish(COMMAND, joints.fill(message_class(JOINT_STATE)(), names, action))


class Swing:
    """Swings all joints without ever resting, in chunks of a second; ``spoil`` changes the next."""

    embodiment = ARM
    action_rate_hz = 10.0
    horizon = 10

    def __init__(self) -> None:
        self.spoil: Callable[[Array], Any] | None = None
        self.spoiled: float | None = None

    def reset(self, seed: int) -> None:
        self.began = time.monotonic()

    def predict_action(self, observation: Mapping[str, Any]) -> Any:
        ahead = np.arange(1, self.horizon + 1) / self.action_rate_hz
        phase = np.sin(1.5 * (time.monotonic() - self.began + ahead))
        chunk = phase[:, None] * np.array([0.5, 0.5, 0.3]) + np.array([0.0, 0.0, 0.5])
        if self.spoil is None:
            time.sleep(0.02)
            return chunk
        if self.spoiled is None:
            self.spoiled = time.monotonic()
        return self.spoil(chunk)


@dataclass
class Stage:
    """Who takes part in a fault: the arm's process, the listener, operator, policy, runner."""

    folder: Path
    robot: Driver
    ear: Driver
    empty_domain: int
    operator: BenchArm = field(default_factory=BenchArm)
    policy: Swing = field(default_factory=Swing)
    arguments: dict[str, Any] = field(default_factory=dict)
    task: str = "1"
    most: int = 1000
    # What a program of its own drives.
    arm: str = "ProgramArm"
    safety: Mapping[str, float] = field(default_factory=dict)
    more: list[Any] = field(default_factory=list)

    def runner(self) -> BaseInferenceRunner:
        context = RunContext(section="inference", work_dir=self.folder, task=self.task)
        given: dict[str, Any] = {
            "operator": self.operator,
            "policy": self.policy,
            "task_descriptions": {"1": "swing"},
            "async_execution": True,
            "record_fps": None,
            "max_publish_step": self.most,
        }
        return BaseInferenceRunner(context=context, **{**given, **self.arguments})

    def commands(self) -> list[tuple[float, list[float]]]:
        """When the listener received each of the runner's commands, and the positions in it."""
        heard = [h for h in self.ear.on(COMMAND) if tuple(h["name"]) == NAMES]
        return [(h["at"], h["position"]) for h in heard]

    def spoil(self, change: Callable[[Array], Any]) -> None:
        self.policy.spoil = change


@dataclass(frozen=True)
class Fault:
    """One row of the table.

    Args:
        name: as docs/safety.md has it.
        provoke: called with the stage (or the ``Program`` of two processes) once the arm moves;
            before the run for what is ``REFUSED``. False if it did not come about.
        around: called with the stage before the run, which is inside of the context.
        environment: of all processes; such a fault has a crew of its own.
        attempts: how often it is tried until it comes about: a machine that stalls stops the arm,
            rightly, before.
        says: what the one line that names the cause contains, a regular expression.
        outcome: ``STOP``, ``REFUSED`` or ``GOES_ON``.
        exit_code: of the program.
        rule: that tripped, as the record has it; None where somebody ended the run, or it went on.
        after: called when the run is over; nothing may move because of it.
        braked: whether every joint is slowed down within its limits; those that do not obey halt at
            once, and nothing more is sent where somebody else commands.
    """

    name: str
    provoke: Callable[[Any], object]
    says: str = ""
    outcome: str = STOP
    exit_code: int = 1
    rule: str | None = None
    around: Callable[[Stage], AbstractContextManager[object]] = nullcontext
    environment: Mapping[str, str] = field(default_factory=dict)
    attempts: int = 4
    after: Callable[[Stage], object] | None = None
    braked: bool = True

    @property
    def interrupts(self) -> bool:
        """Whether a person or the system ended the run."""
        return self.rule is None

    def matches(self, said: str) -> bool:
        """Whether ``said`` names it; of what goes on nothing is said."""
        return bool(re.search(self.says, said)) if self.says else said == ""


@dataclass(frozen=True)
class Result:
    """What came of a fault.

    Args:
        hold_s: from the fault to the receipt of the command at which the arm rests; None where
            nothing moved or the run went on.
        said: the cause; one line where something moved.
        said_s: from the start of the run to its end.
        exit_code: of the program.
        record: ``episode.json``, None where there was no episode.
        commands: what the listener received, ``(N, 3)``.
        provoked: whether the fault was there; a machine that stalls may stop the arm before.
        late: how many commands that moved the arm came after the fault, of a program of its own. A
            machine that stands still meanwhile makes ``hold_s`` longer, and these no more.
    """

    hold_s: float | None
    said: str
    said_s: float
    exit_code: int
    record: dict[str, Any] | None
    commands: Array
    provoked: bool
    late: int | None = None


@contextmanager
def stage_crew(environment: Mapping[str, str] | None = None) -> Iterator[Callable[[Path], Stage]]:
    """A domain, the arm's process and the listener; call it with a folder for each fault."""
    with claimed_domain() as domain, claimed_domain() as empty:
        before = dict(os.environ)
        os.environ.update(
            ROS_DOMAIN_ID=str(domain),
            ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST",
            **(environment or {}),
        )
        crew: list[Driver] = []
        try:
            crew += [Driver(STREAMS, SINKS, name="robot"), Driver([], SINKS, name="ear")]

            def make(folder: Path) -> Stage:
                if crew[0].exit_code is not None:
                    crew[0] = Driver(STREAMS, SINKS, name="robot")
                robot, ear = crew
                robot.tell(reset=True)
                made = Stage(folder, robot, ear, empty)
                # What a process that was killed sent last may still arrive.
                settled(made)
                ear.heard.clear()
                return made

            yield make
        finally:
            for driver in crew:
                driver.close()
            os.environ.clear()
            os.environ.update(before)


def play(stage: Stage, fault: Fault) -> Result:
    """Run, provoke, and see what came of it.

    Raises:
        AssertionError: a command that was received is outside a limit, or moves the arm after
            the run was over.
    """
    began: list[float] = []
    over = threading.Event()

    def provoke() -> None:
        while len(stage.commands()) < MOVING:
            if over.wait(0.005):
                return
        began.append(time.monotonic())
        fault.provoke(stage)

    said, code, ended = "", 0, time.monotonic()
    start = time.monotonic()
    thread = threading.Thread(target=provoke, daemon=True)
    if fault.outcome == GOES_ON:
        stage.most = MOVING + GOING_ON
    try:
        if fault.outcome == REFUSED:
            fault.provoke(stage)
        runner = stage.runner()
        runner.run_setup()
        if fault.outcome != REFUSED:
            thread.start()
        runner.run()
    except FluxError as error:
        said, code = error.what, error.exit_code
    except KeyboardInterrupt as error:
        said, code = str(error), 130
    finally:
        ended = time.monotonic()
        over.set()
        if thread.ident is not None:
            thread.join(60)
        for driver in stage.more:
            driver.close()
    commands = settled(stage)
    if fault.after is not None:
        fault.after(stage)
        assert settled(stage) == commands, "the arm was commanded after the run was over"
    positions = np.array([c for _, c in commands]).reshape(-1, len(NAMES))
    whole = with_overtaken(positions.tolist(), stage.operator.sent)
    check_limits(whole, halts=not fault.braked)
    hold = None
    if fault.outcome == STOP and began and commands:
        strangers = [h["at"] for h in stage.ear.on(COMMAND) if tuple(h["name"]) != NAMES]
        fell_ill = min(strangers, default=stage.policy.spoiled or began[0])
        hold = max(commands[-resting(positions)][0] - fell_ill, 0.0)
    provoked = fault.outcome == REFUSED or bool(began)
    return Result(hold, said, ended - start, code, record_of(stage.folder), positions, provoked)


def settled(stage: Stage) -> list[tuple[float, list[float]]]:
    """What was received once nothing more comes."""
    found = stage.commands()
    while True:
        time.sleep(0.25)
        now = stage.commands()
        if len(now) == len(found):
            return now
        found = now


def with_overtaken(received: list[list[float]], sent: list[list[float]]) -> Array:
    """What was received, with the commands between that a newer one overtook: ``(N, 3)``.

    A command that was not taken before the next is there is dropped, and a starved listener is
    slow. The next one is not a jump then: more time went by.

    Raises:
        AssertionError: something was received that was not sent, or in another order.
    """
    at = [0]
    for command in received:
        assert command in sent[at[-1] :], "what was received is not what was sent"
        at.append(sent.index(command, at[-1]) + 1)
    return np.array(sent[at[1] - 1 : at[-1]] if received else []).reshape(-1, len(NAMES))


def resting(positions: Array) -> int:
    """How many commands at the end are equal."""
    if not len(positions):
        return 0
    moving = np.flatnonzero((positions != positions[-1]).any(axis=1))
    return len(positions) - (int(moving[-1]) + 1 if moving.size else 0)


def check_limits(positions: Array, halts: bool = False) -> None:
    """Position, velocity and acceleration of ``(N, 3)`` commands in a row.

    Args:
        halts: a joint may come to rest at once, and set off from there.

    Raises:
        AssertionError: a command is outside a limit.
    """
    if len(positions) < 3:
        return
    assert np.isfinite(positions).all()
    speed = np.diff(positions, axis=0) * ARM.rate_hz
    push = np.diff(speed, axis=0) * ARM.rate_hz
    for index, joint in enumerate(ARM.joints):
        slack = 1.0 + ROUNDING
        assert joint.lower <= positions[:, index].min()
        assert positions[:, index].max() <= joint.upper
        assert np.abs(speed[:, index]).max() <= joint.velocity * slack, joint.name
        beyond = np.flatnonzero(np.abs(push[:, index]) > joint.acceleration * slack)
        assert beyond.size <= halts, joint.name
        for halt in beyond:
            assert abs(speed[halt + 1, index]) <= joint.acceleration / ARM.rate_hz * slack


def record_of(folder: Path) -> dict[str, Any] | None:
    found = sorted((folder / "inference").glob("*/episode.json"))
    return json.loads(found[-1].read_text(encoding="utf-8")) if found else None
