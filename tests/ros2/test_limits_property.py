"""Whatever a policy and a robot's streams say, nothing beyond a limit arrives on the other side.

A simulated clock drives the real control loop as fast as it can; every command goes through DDS to
a process that only listens, and what that process heard is held against the limits, from positions
alone. The chunks, the readings, the arm and what is done to it between two episodes are hypothesis'
(``adversarial``): far away, to and fro, nearly right, no numbers, of other shapes, stale, from the
future; drooping, lagging, overshooting, slowed down, pushed. What its stops send is among them.
"""

from __future__ import annotations

import time
from collections import Counter

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, example, given, settings

from fluxvla_core import BaseInferenceRunner, RunContext
from fluxvla_core.errors import FluxError
from fluxvla_core.ros2 import JOINT_STATE, Connection, joints, message_class
from fluxvla_core.testing.ros2_driver import Driver
from tests.ros2.adversarial import (
    ARM,
    CHUNKS,
    EXAMPLES,
    FILTERS,
    SCRIPTS,
    SETTINGS,
    Adversary,
    arm_of,
    hold_against_limits,
)

TOPIC = "/arm/command"
NAMES = list(ARM.joint_names)
# What a listener's queue holds; so many commands are under way at most.
UNDER_WAY = 40


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


@pytest.fixture(scope="module")
def heard(ros_domain):
    side = Heard()
    yield side
    side.close()


@pytest.mark.parametrize("examples", [20, pytest.param(260, marks=pytest.mark.slow)])
def test_nothing_beyond_a_limit_arrives(heard, tmp_path, examples):
    """Some 900 chunks and as many readings here, more than 10,000 of each every night."""
    count = Counter()

    @settings(
        max_examples=examples,
        deadline=None,
        derandomize=True,
        database=None,
        # To shrink it, a failing script would be played for minutes.
        phases=[Phase.explicit, Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(SCRIPTS, SETTINGS)
    @example(*EXAMPLES[0])
    @example(*EXAMPLES[1])
    def play(script, case):
        arm = arm_of(heard.send, case)
        policy = Adversary(arm, script, case["rate"])
        runner = BaseInferenceRunner(
            context=RunContext(section="inference", work_dir=tmp_path, task="1"),
            operator=arm,
            policy=policy,
            task_descriptions={"1": "do harm"},
            execute_horizon=case["execute_horizon"],
            chunk_joining=case["joining"],
            simulated_latency=case["latency"],
            action_filters=FILTERS[case["filters"]](),
            prepare_pose=case["start_pose"],
            safety=case["safety"],
            record_fps=None,
        )
        runner.run_setup()
        stops = 0
        while not policy.over:
            start = arm.beginning()
            moved = arm.last is not None and (start != arm.last).any()
            with pytest.raises(FluxError):
                runner.run()
            rule = runner.latch.tripped.rule
            runner.latch.rearm()
            path = heard.take()
            hold_against_limits(path, start, halts=rule == "tracking")
            arm.pushed(case["pushes"][stops % len(case["pushes"])])
            stops += 1
            assert stops <= 2 * CHUNKS, f"it does not get going: {rule}"
            count.update(commands=len(path), stops=1)
            kind = "moved" if moved else "stayed"
            count[f"{kind}, {'told' if case['tells'] else 'untold'}"] += len(path) > 0
            count[f"stopped by {rule}"] += 1
        count.update(
            {
                "chunks": policy.played,
                "continued": policy.continued,
                "on the way to a start pose": case["start_pose"] is not None,
                "slowed": bool(case["shares"]),
                "filtered": case["filters"] != "none",
                "drooping": case["droop"] > 0,
                "lagging": case["follows"] < 1,
                "overshooting": case["follows"] > 1,
                "readable": case["readable"],
                "pushed": policy.pushes,
            }
        )

    play()

    assert count["chunks"] == (examples + len(EXAMPLES)) * CHUNKS
    assert count["commands"] > count["chunks"], count
    assert count["stops"] > examples, count
    # Every way of using the limits was gone.
    assert min(count.values()) > 0, count
    assert {"stopped by tracking", "stopped by chunk", "stopped by policy"} <= set(count), count
    assert len([name for name in count if not name.startswith("stopped")]) == 16, count
