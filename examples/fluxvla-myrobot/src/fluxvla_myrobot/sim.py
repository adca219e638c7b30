"""``python -m fluxvla_myrobot.sim arm|arms``: simulated robots behind the example's topics.

``arm`` is a UR5e with a gripper, ``arms`` are an ALOHA's; physics and cameras are fluxvla-sim's
(``pip install fluxvla-sim``). What is here stands for the robot's own driver.
"""

from __future__ import annotations

import sys

import numpy as np
from fluxvla_sim.aloha.world import CUBE as TWO_ARMS
from fluxvla_sim.ros2.node import simulate
from fluxvla_sim.ros2.settings import NodeSettings
from fluxvla_sim.ur import CUBE as ONE_ARM

from fluxvla_core.commands import make_reporter
from fluxvla_core.ros2 import FLOAT64, JOINT_STATE, BadMessage, joints, message_class
from fluxvla_myrobot.embodiment import DUAL_ARM, SIZE, SPEC


class Driver:
    """All joints on one topic, commands in the same order; see ``fluxvla_sim.ros2.drivers``."""

    latched, depths, knobs = {}, {}, {}

    def __init__(self, spec, cameras, states, commands, gripper=None):
        self.cameras = cameras
        self.states = {"joints": (states, JOINT_STATE)}
        self.commands = {commands: JOINT_STATE, **({gripper: FLOAT64} if gripper else {})}
        self._names = spec.joint_names
        # The simulation's grippers go from 0 to 1.
        self._scale = np.array([joint.open or 1.0 for joint in spec.joints])

    def messages(self, state, now):
        message = message_class(JOINT_STATE)()
        return {"joints": joints.fill(message, self._names, state * self._scale)}

    def receive(self, topic, message, now):
        first = 0 if self.commands[topic] == JOINT_STATE else len(self._names) - 1
        values = np.atleast_1d(message.data if first else message.position)
        columns = slice(first, first + len(values))
        if not np.isfinite(values).all() or columns.stop > len(self._names):
            raise BadMessage(f"{topic}: this is not a command: {values.tolist()}")
        self._target[columns] = values / self._scale[columns]

    def target(self, now):
        return self._target

    def reset(self, state):
        self._target = state.copy()


def main(robot: str) -> None:
    """Simulate until Ctrl-C."""
    if robot == "arm":
        cameras = {"front": "/camera/color/image_raw", "wrist": "/wrist_camera/color/image_raw"}
        driver = Driver(SPEC, cameras, "/joint_states", "/joint_commands", "/gripper_command")
    else:
        cameras = {"top": "/my_camera/rgb"}
        driver = Driver(DUAL_ARM, cameras, "/my_robot/joints", "/my_robot/commands")
    settings = NodeSettings(f"my_{robot}", height=SIZE, width=SIZE)
    world = ONE_ARM if robot == "arm" else TWO_ARMS
    simulate(driver, world, settings, make_reporter("text"))


if __name__ == "__main__":
    if sys.argv[1:] not in (["arm"], ["arms"]):
        sys.exit("usage: python -m fluxvla_myrobot.sim arm|arms")
    main(sys.argv[1])
