"""An arm in memory and a policy in words, each with the faults that tests ask for."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fluxvla_core.build import RunContext
from fluxvla_core.commands import SilentReporter
from fluxvla_core.contracts.frame import Frame
from fluxvla_core.control.clock import SimulatedClock
from fluxvla_core.robot.runner import BaseInferenceRunner
from fluxvla_core.ros2 import RobotFrame
from fluxvla_core.spec import Camera, EmbodimentSpec, Joint

ARM = EmbodimentSpec(
    "testarm",
    (
        Joint("shoulder", "rad", -1.0, 1.5, 2.0, 10.0),
        Joint("elbow", "rad", -2.0, 2.0, 3.0, 20.0),
        Joint("jaw", "normalized", 0.0, 1.0, 2.0, 30.0, kind="gripper", open=1.0, closed=0.0),
    ),
    (Camera("front", 24, 32),),
    50.0,
)
HOME = (0.0, 0.0, 0.5)
TASKS = {"1": "wave at the camera", "2": "lift the red cube"}


class Arm:
    """Follows each command at once; keeps everything that was sent, and when."""

    api = "1.0"

    def __init__(self, realtime: bool = False, embodiment: EmbodimentSpec = ARM) -> None:
        self.embodiment = embodiment
        self.clock = None if realtime else SimulatedClock()
        self.state = np.array(HOME)
        self.sent: list[np.ndarray] = []
        self.calls: list[str] = []
        self.faults: dict[str, Any] = {}
        self.goal: float | None = None

    def now(self) -> float:
        return time.monotonic() if self.clock is None else self.clock.now()

    def connect(self) -> None:
        self.calls.append("connect")

    def get_frame(self) -> Frame:
        self._fault("get_frame")
        images = {
            c.name: np.full((c.height, c.width, 3), len(self.sent) % 256, np.uint8)
            for c in self.embodiment.cameras
        }
        if len(self.sent) < self.faults.get("frozen_after", np.inf):
            self.stamped = self.now()
        stamps = dict.fromkeys(("state", *images), self.stamped)
        return Frame(self.state.copy(), images, stamps)

    def send_action(self, action: np.ndarray) -> None:
        self._fault("send_action")
        self.sent.append(np.array(action))
        if not self.faults.get("stuck"):
            self.state = np.array(action)
        if self.clock is not None:
            self.clock.advance(1 / self.embodiment.rate_hz)

    def stop(self) -> None:
        self.calls.append("stop")
        self._fault("stop")

    def close(self) -> None:
        self.calls.append("close")

    def task_done(self) -> bool:
        return self.goal is not None and bool(self.state[0] >= self.goal)

    def task_success(self) -> bool:
        return self.task_done()

    def _fault(self, name: str) -> None:
        fault = self.faults.get(name)
        after = self.faults.get("after", 0)
        if fault is not None and len(self.sent) >= after:
            if isinstance(fault, BaseException):
                raise fault
            fault()


class Rover(Arm):
    """The arm on a base, whose camera measures distances, in millimetres and with holes.

    What it sees and how fast it is follows from how often it was commanded.
    """

    def get_frame(self) -> RobotFrame:
        frame = super().get_frame()
        stamps = {**frame.stamps, "front_depth": frame.stamps["front"] - 0.001}
        depths = {"front": self.depth(len(self.sent))}
        base = np.array(self.speeds(len(self.sent)))
        return RobotFrame(frame.state, frame.images, stamps, depths, base)

    @staticmethod
    def depth(count: int) -> np.ndarray:
        millimetres = np.arange(24 * 32, dtype=np.uint16).reshape(24, 32) * 80 + count
        metres = millimetres.astype(np.float32) * np.float32(1e-3)
        metres[count % 24] = np.nan
        return metres

    @staticmethod
    def speeds(count: int) -> list[float]:
        return [0.01 * count, -0.002 * count]


class Waver:
    """Moves the shoulder towards ``goal`` in steps of at most ``stride`` an action."""

    def __init__(self, goal: float = 0.8, stride: float = 0.1, horizon: int = 5) -> None:
        self.embodiment = ARM
        self.action_rate_hz = 10.0
        self.horizon = horizon
        self.goal = goal
        self.stride = stride
        self.asked: list[dict[str, Any]] = []
        self.seeds: list[int] = []
        self.faults: dict[int, Any] = {}

    def reset(self, seed: int) -> None:
        self.seeds.append(seed)

    def predict_action(self, observation: dict[str, Any]) -> np.ndarray:
        self.asked.append(observation)
        fault = self.faults.get(len(self.asked))
        if isinstance(fault, BaseException):
            raise fault
        pose = np.asarray(observation["qpos"], dtype=np.float64)
        chunk = np.repeat(pose[None], self.horizon, axis=0)
        way = self.stride * np.arange(1, self.horizon + 1)
        left = self.goal - pose[0]
        chunk[:, 0] = pose[0] + np.sign(left) * np.minimum(way, abs(left))
        return chunk if fault is None else fault(chunk)


class Notes(SilentReporter):
    """A reporter that remembers."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.artifacts: list[tuple[str, Path]] = []

    def info(self, text: str) -> None:
        self.lines.append(text)

    def warn(self, text: str) -> None:
        self.lines.append(f"warning: {text}")

    def artifact(self, kind: str, path: Path) -> None:
        self.artifacts.append((kind, path))


class Bench:
    """Makes runners on one arm and one policy, and reads what they leave behind."""

    def __init__(self, work_dir: Path) -> None:
        self.work_dir = work_dir
        self.notes = Notes()
        self.arm = Arm()
        self.policy = Waver()

    def runner(
        self,
        cls: type[BaseInferenceRunner] = BaseInferenceRunner,
        task: str | None = "1",
        task_file: str | None = None,
        config: dict[str, Any] | None = None,
        **arguments: Any,
    ) -> BaseInferenceRunner:
        context = RunContext(
            config=config or {},
            section="inference",
            work_dir=self.work_dir,
            task=task,
            task_file=task_file,
            reporter=self.notes,
        )
        given: dict[str, Any] = {
            "operator": self.arm,
            "policy": self.policy,
            "task_descriptions": TASKS,
            "max_publish_step": 60,
            "record_fps": None,
        }
        return cls(context=context, **{**given, **arguments})

    def run(self, **arguments: Any) -> dict[str, Any]:
        runner = self.runner(**arguments)
        runner.run_setup()
        return runner.run()

    def episode(self, name: str = "001-1") -> dict[str, Any]:
        return json.loads((self.work_dir / "inference" / name / "episode.json").read_text())

    def trace(self, name: str = "001-1") -> list[dict[str, Any]]:
        """What happened, without the events that say what it was made of."""
        lines = (self.work_dir / "inference" / name / "trace.jsonl").read_text().splitlines()
        frame = ("start", "observation", "end")
        return [row for row in map(json.loads, lines) if row["event"] not in frame]

    def assert_within_limits(
        self, start: tuple[float, ...] = HOME, sent: list[np.ndarray] | None = None
    ) -> None:
        """Whatever was sent, or this part of it, kept every limit, from positions alone."""
        sent = self.arm.sent if sent is None else sent
        if not sent:
            return
        path = np.vstack([start, start, *sent])
        speed = np.diff(path, axis=0) * self.arm.embodiment.rate_hz
        push = np.diff(speed, axis=0) * self.arm.embodiment.rate_hz
        for index, joint in enumerate(self.arm.embodiment.joints):
            assert path[:, index].min() >= joint.lower
            assert path[:, index].max() <= joint.upper
            assert np.abs(speed[:, index]).max() <= joint.velocity
            assert np.abs(push[:, index]).max() <= joint.acceleration


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


@pytest.fixture(scope="session")
def make_bench() -> type[Bench]:
    return Bench


@pytest.fixture
def make_arm() -> type[Arm]:
    return Arm


@pytest.fixture
def make_rover() -> type[Rover]:
    return Rover


@pytest.fixture
def make_waver() -> type[Waver]:
    return Waver


@pytest.fixture
def hang():
    """A call that does not return before the test is over."""
    over = threading.Event()

    def wait(*_: Any) -> None:
        over.wait(60)

    yield wait
    over.set()


@pytest.fixture
def asked(monkeypatch):
    """``asked(person)``: whatever the command line says, this person gives the tasks."""

    def say(person):
        monkeypatch.setattr(BaseInferenceRunner, "_task_source", lambda self: person)
        return person

    return say
