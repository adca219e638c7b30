"""The mobile base under a simulated ALOHA."""

from __future__ import annotations

import math
from typing import Any

from fluxvla_core.ros2 import ODOMETRY, BadMessage, message_class

TIMEOUT_S = 0.5
"""A speed that is not asked for again within this time ends, as real bases have it."""


class Base:
    """Takes a ``Twist``, tells its ``Odometry``: a differential drive that has its speed at once.

    The scene does not move: table and objects would have to come along. Where the base is, only its
    odometry says.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Stand still, where odometry begins."""
        self._x = self._y = self._heading = 0.0
        self._forward = self._turning = 0.0
        self._at = self._until = 0.0

    def hear(self, message: Any, topic: str, now: float) -> None:
        """Take a speed.

        Raises:
            BadMessage: it is not finite.
        """
        forward, turning = float(message.linear.x), float(message.angular.z)
        if not (math.isfinite(forward) and math.isfinite(turning)):
            raise BadMessage(f"{topic}: a speed is not finite")
        self._roll(now)
        self._forward, self._turning = forward, turning
        self._until = now + TIMEOUT_S

    def say(self, now: float) -> Any:
        """The odometry at ``now``."""
        self._roll(now)
        message = message_class(ODOMETRY)()
        message.header.frame_id, message.child_frame_id = "odom", "base_link"
        pose, twist = message.pose.pose, message.twist.twist
        pose.position.x, pose.position.y = self._x, self._y
        pose.orientation.z = math.sin(self._heading / 2)
        pose.orientation.w = math.cos(self._heading / 2)
        twist.linear.x, twist.angular.z = self._forward, self._turning
        return message

    def _roll(self, now: float) -> None:
        passed = min(now, self._until) - self._at
        if passed > 0:
            # Half of the turn before the way, half after it: exact to the second order.
            self._heading += self._turning * passed / 2
            self._x += self._forward * passed * math.cos(self._heading)
            self._y += self._forward * passed * math.sin(self._heading)
            self._heading += self._turning * passed / 2
        self._at = now
        if now >= self._until:
            self._forward = self._turning = 0.0
