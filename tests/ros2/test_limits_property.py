"""Whatever a policy and a robot's streams say, nothing beyond a limit arrives on the other side.

A simulated clock drives the real control loop as fast as it can; every command goes through DDS to
a process that only listens, and what that process heard is held against the limits, from positions
alone. The chunks and the readings are hypothesis': far away, to and fro, nearly right, no numbers,
of other shapes, stale, from the future.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from fluxvla_core import BaseInferenceRunner, Frame, RunContext
from fluxvla_core.control.clock import SimulatedClock
from fluxvla_core.control.joiners import METHODS
from fluxvla_core.errors import FluxError
from fluxvla_core.ros2 import joints
from fluxvla_core.ros2.connection import Connection
from fluxvla_core.ros2.require import message_class
from fluxvla_core.ros2.streams import JOINT_STATE
from fluxvla_core.spec.embodiment import Camera, EmbodimentSpec, Joint
from fluxvla_core.testing.ros2_driver import Driver

TOPIC = "/arm/command"
ARM = EmbodimentSpec(
    "arm",
    (
        Joint("shoulder", "rad", -1.0, 1.5, 2.0, 10.0),
        Joint("slide", "m", 0.0, 0.4, 0.5, 3.0, kind="prismatic"),
        Joint("jaw", "normalized", 0.0, 1.0, 2.28, 30.0, kind="gripper", open=1.0, closed=0.0),
    ),
    (Camera("front", 8, 8),),
    50.0,
)
LOWER, UPPER = np.array([(j.lower, j.upper) for j in ARM.joints]).T
NAMES = list(ARM.joint_names)
# What a listener's queue holds; so many commands are under way at most.
UNDER_WAY = 40
CHUNKS = 40
# No rule but the limits is in the way of these.
LIMITS_ALONE = {"jump_s": 1e12, "excess": 1e12, "tracking_error": 1e12}
# Where the arm does not obey, its last command is repeated at once instead of braking.
UNBRAKED = ("tracking", "operator", "execute")


class Heard:
    """The other side: every command that arrived, in the order of its sending."""

    def __init__(self) -> None:
        self.connection = Connection("sender")
        self.driver = Driver([], [{"topic": TOPIC, "message": JOINT_STATE}], name="listener")
        self.cls = message_class(JOINT_STATE)
        self.publisher = self.connection.publisher(TOPIC, self.cls, depth=2 * UNDER_WAY)
        self.sent = 0
        self._wait(lambda: self.publisher.get_subscription_count() == 1, "nobody listens")
        # The writer knows the reader now; once a message came through, both know each other.
        self._wait(lambda: self._hello(), "nothing arrives")
        self.forget()

    def send(self, action: np.ndarray) -> None:
        self.publisher.publish(joints.fill(self.cls(), NAMES, action))
        self.sent += 1
        if self.sent % UNDER_WAY == 0:
            self.settle()

    def settle(self) -> None:
        self._wait(lambda: len(self.driver.heard) >= self.sent, "a command was lost")

    def forget(self) -> None:
        time.sleep(0.2)
        self.driver.heard.clear()
        self.sent = 0

    def take(self) -> np.ndarray:
        self.settle()
        path = np.array([h["position"] for h in self.driver.heard]).reshape(-1, len(NAMES))
        self.driver.heard.clear()
        self.sent = 0
        return path

    def close(self) -> None:
        self.driver.close()
        self.connection.close()

    def _hello(self) -> bool:
        self.publisher.publish(joints.fill(self.cls(), NAMES, np.zeros(3)))
        time.sleep(0.05)
        return bool(self.driver.heard)

    def _wait(self, condition, what: str) -> None:
        until = time.monotonic() + 120
        while not condition():
            assert time.monotonic() < until, what
            time.sleep(0.0005)


class Arm:
    """Follows each command at once, on a clock of its own; lies about itself when told to."""

    api = "1.0"
    embodiment = ARM

    def __init__(self, heard: Heard) -> None:
        self.heard = heard
        self.clock = SimulatedClock()
        self.pose = np.array([0.1, 0.2, 0.5])
        self.lie: tuple[str, float] | None = None
        self.calls: list[str] = []

    def connect(self) -> None:
        self.lie = None

    def get_frame(self) -> Frame:
        kind, amount = self.lie or ("", 0.0)
        now, state, image = self.clock.now(), self.pose.copy(), np.zeros((8, 8, 3), np.uint8)
        stamps = {"state": now, "front": now}
        if kind == "noise":
            state += amount * 1e-3
        elif kind == "elsewhere":
            state += amount
        elif kind == "nan":
            state[int(abs(amount)) % 3] = np.nan
        elif kind == "short":
            state = state[:2]
        elif kind == "picture":
            image = np.zeros((4, 8, 3), np.uint8)
        elif kind == "stamps":
            stamps["front"] += amount
        return Frame(state, {} if kind == "blind" else {"front": image}, stamps)

    def send_action(self, action: np.ndarray) -> None:
        self.heard.send(action)
        self.pose = np.array(action)
        self.clock.advance(1 / ARM.rate_hz)

    def stop(self) -> None:
        self.calls.append("stop")

    def close(self) -> None:
        self.calls.append("close")


class Adversary:
    """Plays a script of moves, one for each chunk; ends the episode after the last."""

    embodiment = ARM
    horizon = 4
    action_rate_hz = 25.0

    def __init__(self, arm: Arm, script: list[tuple[str, float, float, str]]) -> None:
        self.arm = arm
        self.script = script
        self.played = 0

    @property
    def over(self) -> bool:
        return self.played == len(self.script)

    def reset(self, seed: int) -> None:
        self.arm.lie = None

    def predict_action(self, observation: dict[str, Any]) -> np.ndarray:
        if self.over:
            raise ValueError("the script is over")
        kind, a, b, lie = self.script[self.played]
        self.played += 1
        self.arm.lie = (lie, b) if lie else None
        return chunk_of(kind, a, b, self.arm.pose)


def chunk_of(kind: str, a: float, b: float, pose: np.ndarray) -> np.ndarray:
    """``(4, 3)`` keyframes, or what somebody took for it."""
    steps = np.arange(1, 5)[:, None]
    way = np.array([a, b, a - b])
    if kind == "far":
        return pose + steps * way
    if kind == "spike":
        return pose + np.where(steps == 2, way, 0.0)
    if kind == "to and fro":
        return np.where(steps % 2, LOWER, UPPER) + 1e-3 * way
    if kind == "sweep":
        return np.linspace(LOWER - abs(a), UPPER + abs(b), 4)
    if kind == "near":
        return pose + steps * way * 1e-3
    if kind == "huge":
        return np.full((4, 3), np.copysign(1e300, a))
    if kind == "nan":
        return np.where(steps == 3, np.nan, pose + 0 * steps)
    if kind == "shape":
        return np.zeros((4, 2))
    return np.repeat(pose[None], 4, axis=0)


MOVES = ["far", "spike", "to and fro", "sweep", "near", "huge", "rest"]
LIES = ["", "", "", "noise"]
AMOUNTS = st.floats(-50.0, 50.0, allow_nan=False) | st.floats(-0.2, 0.2, allow_nan=False)
# Nine in ten go on; what ends an episode (and begins the next) comes between them.
GOOD = st.tuples(st.sampled_from(MOVES), AMOUNTS, AMOUNTS, st.sampled_from(LIES))
ENDING = st.tuples(
    st.sampled_from([*MOVES, "nan", "shape"]),
    AMOUNTS,
    AMOUNTS,
    st.sampled_from(["", "elsewhere", "nan", "short", "picture", "stamps", "blind"]),
)
MOVE = st.integers(0, 9).flatmap(lambda n: ENDING if n == 0 else GOOD)
SCRIPTS = st.lists(MOVE, min_size=CHUNKS, max_size=CHUNKS)
SETTINGS = st.fixed_dictionaries(
    {
        "safety": st.sampled_from([LIMITS_ALONE, LIMITS_ALONE, {}]),
        "execute_horizon": st.sampled_from([1, 2, 4, None]),
        "rate": st.sampled_from([25.0, 10.0]),
        # Real-time chunking needs a policy that can be asked to go on from where it is.
        "joining": st.sampled_from([method for method in METHODS if method != "rtc"]),
    }
)


def hold_against_limits(path: np.ndarray, start: np.ndarray, braked: bool) -> None:
    """Positions, speeds and accelerations of ``(N, 3)`` commands from rest at ``start``."""
    if not len(path):
        return
    assert np.isfinite(path).all()
    whole = np.vstack([start, start, path])
    speed = np.diff(whole, axis=0) * ARM.rate_hz
    push = np.diff(speed, axis=0) * ARM.rate_hz
    for column, joint in enumerate(ARM.joints):
        assert path[:, column].min() >= joint.lower, joint.name
        assert path[:, column].max() <= joint.upper, joint.name
        assert np.abs(speed[:, column]).max() <= joint.velocity, joint.name
        assert np.abs(push[:, column]).max() <= joint.acceleration, joint.name
        if braked:
            assert abs(speed[-1, column]) <= joint.acceleration / ARM.rate_hz, joint.name


@pytest.fixture(scope="module")
def heard(ros_domain):
    side = Heard()
    yield side
    side.close()


@pytest.mark.parametrize("examples", [20, pytest.param(260, marks=pytest.mark.slow)])
def test_nothing_beyond_a_limit_arrives(heard, tmp_path, examples):
    """Some 800 chunks and as many readings here, more than 10,000 of each every night."""
    count = {"chunks": 0, "commands": 0, "stops": 0}

    @settings(
        max_examples=examples,
        deadline=None,
        derandomize=True,
        database=None,
        # To shrink it, a failing script would be played for minutes.
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(SCRIPTS, SETTINGS)
    def play(script, given_settings):
        arm = Arm(heard)
        policy = Adversary(arm, script)
        policy.action_rate_hz = given_settings["rate"]
        runner = BaseInferenceRunner(
            context=RunContext(section="inference", work_dir=tmp_path, task="1"),
            operator=arm,
            policy=policy,
            task_descriptions={"1": "do harm"},
            execute_horizon=given_settings["execute_horizon"],
            chunk_joining=given_settings["joining"],
            safety=given_settings["safety"],
            record_fps=None,
        )
        runner.run_setup()
        while not policy.over:
            start = arm.pose.copy()
            with pytest.raises(FluxError):
                runner.run()
            rule = runner.latch.tripped.rule
            runner.latch.rearm()
            path = heard.take()
            hold_against_limits(path, start, rule not in UNBRAKED)
            count["commands"] += len(path)
            count["stops"] += 1
        count["chunks"] += policy.played

    play()

    assert count["chunks"] == examples * CHUNKS
    assert count["commands"] > count["chunks"], count
    assert count["stops"] > examples, count
