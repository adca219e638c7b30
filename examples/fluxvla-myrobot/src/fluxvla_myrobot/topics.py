"""A robot in memory that is spoken to by topics: six joints, a gripper, two cameras.

It takes the place of ROS in the example. The arm is where it was last commanded to be, and answers
each joint command with its joint states and pictures.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

JOINT_STATES = "/joint_states"
JOINT_COMMANDS = "/joint_commands"
GRIPPER_COMMAND = "/gripper_command"
FRONT = "/camera/color/image_raw"
WRIST = "/wrist_camera/color/image_raw"
HOME = (0.0, -1.57, 1.57, 0.0, 1.57, 0.0, 0.085)
SIZE = 32
STROKE = 0.085


@dataclass
class JointState:
    """Positions in rad; the last of seven is the gripper's opening in m."""

    position: list[float] = field(default_factory=list)


class Robot:
    """The arm and everything that it heard, for whoever wants to look."""

    def __init__(self) -> None:
        self.pose: npt.NDArray[np.float64] = np.array(HOME)
        self.heard: list[npt.NDArray[np.float64]] = []
        self._callbacks: dict[str, list[Callable[[Any], None]]] = defaultdict(list)

    def subscribe(self, topic: str, callback: Callable[[Any], None]) -> None:
        """Have ``callback`` called with every message, and with the present one at once."""
        self._callbacks[topic].append(callback)
        self._tell()

    def receive(self, topic: str, message: Any) -> None:
        """A command arrives; other topics have nobody listening."""
        if topic == JOINT_COMMANDS:
            self.pose[:6] = message.position
            self.heard.append(self.pose.copy())
        elif topic == GRIPPER_COMMAND:
            self.pose[6] = message
        self._tell()

    def _tell(self) -> None:
        state = JointState([float(value) for value in self.pose])
        messages = {JOINT_STATES: state, FRONT: picture(self.pose), WRIST: picture(self.pose[::-1])}
        for topic, message in messages.items():
            for callback in self._callbacks[topic]:
                callback(message)


def picture(pose: npt.NDArray[np.float64]) -> npt.NDArray[np.uint8]:
    """``(32, 32, 3)``: a grey table, a red cup, and a bar that stands where joint 1 points."""
    image = np.full((SIZE, SIZE, 3), 128, np.uint8)
    image[22:28, 20:26] = (200, 30, 30)
    column = int(np.clip(16 + 5 * pose[0], 0, SIZE - 3))
    image[4:20, column : column + 3] = (20, 20, 20 + int(np.clip(pose[1], -1, 1) * 20 + 20))
    return image


ROBOT = Robot()


class Subscriber:
    """As ``rospy.Subscriber(topic, type, callback)``, without the type."""

    def __init__(self, topic: str, callback: Callable[[Any], None]) -> None:
        ROBOT.subscribe(topic, callback)


class Publisher:
    """As ``rospy.Publisher(topic, type)``, without the type."""

    def __init__(self, topic: str) -> None:
        self.topic = topic

    def publish(self, message: Any) -> None:
        """Send one message."""
        ROBOT.receive(self.topic, message)
