"""Velocity commands of a mobile base: limited, and zero when no new one comes in time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from fluxvla_core.errors import ConfigError, Rejected

TIMEOUT_S = 0.25
"""A speed that is not asked for again within this time ends."""


class BaseDrive:
    """Sends speeds through ``publish``; knows nothing of ROS but the fields of a ``Twist``.

    Args:
        publish: takes a message.
        message: makes an empty ``geometry_msgs/Twist``.
        max_linear: largest forward speed, in m/s.
        max_angular: largest turning speed, in rad/s.

    Raises:
        ConfigError: a limit is not positive and finite.
    """

    def __init__(
        self,
        publish: Callable[[Any], None],
        message: Callable[[], Any],
        max_linear: float,
        max_angular: float,
    ) -> None:
        for name, limit in (("base_max_linear", max_linear), ("base_max_angular", max_angular)):
            if not (math.isfinite(limit) and limit > 0):
                raise ConfigError(f"{name} must be positive, got {limit}")
        self._publish = publish
        self._message = message
        self._limits = max_linear, max_angular
        self._until: float | None = None

    def drive(self, linear: float, angular: float) -> None:
        """Drive at ``linear`` m/s and ``angular`` rad/s for ``TIMEOUT_S`` at most.

        Raises:
            Rejected: a speed is not finite or beyond its limit.
        """
        for what, speed, limit, unit in (
            ("forward", linear, self._limits[0], "m/s"),
            ("turning", angular, self._limits[1], "rad/s"),
        ):
            if not abs(speed) <= limit:
                raise Rejected(f"the base's {what} speed {speed} {unit} is beyond {limit:g} {unit}")
        self._send(linear, angular)
        self._until = time.monotonic() + TIMEOUT_S if linear or angular else None

    def halt(self) -> None:
        """Speed zero."""
        self._until = None
        self._send(0.0, 0.0)

    def tick(self) -> None:
        """Speed zero if the last speed has run out; to be called often."""
        if self._until is not None and time.monotonic() > self._until:
            self.halt()

    def _send(self, linear: float, angular: float) -> None:
        message = self._message()
        message.linear.x, message.angular.z = float(linear), float(angular)
        self._publish(message)
