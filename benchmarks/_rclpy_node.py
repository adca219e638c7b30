"""A control program as anybody writes it with rclpy: keeps the newest states, sends at a timer.

    python -m benchmarks._rclpy_node SECONDS

No policy, limits, checks or recording. Prints the share of a core that it took, as a number.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import rclpy
from fluxvla_aloha.embodiment import start_pose
from fluxvla_aloha.presets import COBOT_MAGIC
from rclpy.node import Node
from sensor_msgs.msg import JointState

RATE_HZ = 50.0
WARM_UP_S = 2.0


class ControlNode(Node):
    """Two joint states in, two commands out."""

    def __init__(self) -> None:
        super().__init__("control")
        self.states: dict[str, Any] = {}
        for topic in COBOT_MAGIC.states:
            self.create_subscription(JointState, topic, self._keep(topic), 10)
        self.senders = [self.create_publisher(JointState, t, 10) for t in COBOT_MAGIC.commands]
        self.command = [*start_pose("viperx300")[:6], COBOT_MAGIC.gripper_open]
        self.create_timer(1 / RATE_HZ, self.send)

    def _keep(self, topic: str) -> Any:
        def keep(message: JointState) -> None:
            self.states[topic] = message

        return keep

    def send(self) -> None:
        for sender in self.senders:
            message = JointState(name=list(COBOT_MAGIC.joints))
            message.header.stamp = self.get_clock().now().to_msg()
            message.position = self.command
            sender.publish(message)


def main() -> None:
    rclpy.init()
    node = ControlNode()
    over = time.monotonic() + WARM_UP_S
    while time.monotonic() < over:
        rclpy.spin_once(node, timeout_sec=0.1)
    began, cpu = time.monotonic(), time.process_time()
    over = began + float(sys.argv[1])
    executor = rclpy.get_global_executor()
    executor.add_node(node)
    while time.monotonic() < over:
        executor.spin_once(timeout_sec=0.1)
    print((time.process_time() - cpu) / (time.monotonic() - began))
    assert len(node.states) == len(COBOT_MAGIC.states), "the driver was not heard"
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
