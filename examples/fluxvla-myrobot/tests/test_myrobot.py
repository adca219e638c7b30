"""Both operators do what every operator must, with the robots of ``fluxvla_myrobot.sim``."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import time
from typing import ClassVar

import numpy as np
import pytest

from fluxvla_core import Frame
from fluxvla_core.errors import NotReady
from fluxvla_core.ros2 import JOINT_STATE, Connection, message_class
from fluxvla_core.testing import OperatorConformance
from fluxvla_core.testing.ros2 import ros_domain

pytest.importorskip("fluxvla_myrobot", reason="pip install ./examples/fluxvla-myrobot")

__all__ = ["ros_domain"]

END_S = 30.0
"""How long a simulated robot may take to end after SIGTERM."""


class OnASimulatedRobot(OperatorConformance):
    """With the robot in a process of its own, and somebody who counts its commands."""

    robot: ClassVar[str]
    ready_within_s = 60.0

    @pytest.fixture(scope="class", autouse=True)
    @classmethod
    def simulated(cls, ros_domain):
        words = [sys.executable, "-X", "faulthandler", "-m", "fluxvla_myrobot.sim", cls.robot]
        ears = Connection("ears")
        process = subprocess.Popen(words, stdout=subprocess.DEVNULL)
        try:
            topic = cls.arguments["joint_cmd_topic"]
            cls.heard = ears.subscribe("commands", topic, message_class(JOINT_STATE), 1)
            yield
        finally:
            ears.close()
            end(process)

    @pytest.fixture
    def connected(self, operator):
        """The suite's own, and both listeners have found it: commands before that go lost."""
        operator.connect()
        self.first_frame(operator)
        topic = self.arguments["joint_cmd_topic"]
        (sender,) = (p for p in operator._connection.node.publishers if p.topic_name == topic)
        deadline = time.monotonic() + self.ready_within_s
        while sender.get_subscription_count() < 2:
            assert time.monotonic() < deadline, f"not both listeners found {topic}"
            time.sleep(0.01)
        return operator

    def commands_heard(self, operator):
        return self.heard.ring.received


def end(process):
    """End the simulated robot; one that hangs shows its threads' stacks, and the test fails."""
    process.terminate()
    try:
        process.wait(END_S)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGABRT)  # faulthandler writes the stacks to standard error
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(5.0)
        process.kill()
        process.wait(5.0)
        pytest.fail(f"the simulated robot still ran {END_S:g} s after SIGTERM; its stacks: stderr")


class TestMyRobotOperator(OnASimulatedRobot):
    entry_point = "MyRobotOperator"
    robot = "arm"
    arguments: ClassVar = {
        "img_front_topic": "/camera/color/image_raw",
        "joint_state_topic": "/joint_states",
        "joint_cmd_topic": "/joint_commands",
    }

    @pytest.fixture(autouse=True)
    def nothing_seen(self):
        self.seen = {}

    def frame(self, operator):
        """The page's readings are a dict that its own runner knows, and bear no stamps."""
        found = operator.get_frame()
        if any(reading is None for reading in found.values()):
            raise NotReady("a stream has not come yet")
        buffers = {
            "state": operator._joint_state_buffer,
            "cam_front": operator._img_front_buffer,
            "cam_wrist": operator._img_wrist_buffer,
        }
        images = {"cam_front": found["img_front"], "cam_wrist": found["img_wrist"]}
        stamps = {name: self.since(name, buffer[-1]) for name, buffer in buffers.items()}
        return Frame(np.array(found["joint_state"]), images, stamps)

    def since(self, name, reading):
        """When ``reading`` was first seen."""
        if self.seen.get(name, (None,))[0] is not reading:
            self.seen[name] = reading, time.monotonic()
        return self.seen[name][1]


class TestMyDualArmOperator(OnASimulatedRobot):
    entry_point = "MyDualArmOperator"
    robot = "arms"
    arguments: ClassVar = {
        "img_front_topic": "/my_camera/rgb",
        "joint_state_topic": "/my_robot/joints",
        "joint_cmd_topic": "/my_robot/commands",
        "connect_timeout_s": 60.0,
        "max_age_s": 20.0,
    }
