"""Streaming positions to a UR: the largest step that it takes, and the rate that follows.

With ``forward_position_controller`` the driver hands each position to a program on the robot that
moves there with ``servoj`` in one control cycle, 2 ms: whatever sends the commands interpolates,
and at a low rate the motion is a staircase. The program also guards itself: a position that is
further away than 20 rad/s reach in one cycle, from the last one and from where the arm is, is
ignored, and so is every one after it that is no nearer (``JOINT_IGNORE_SPEED`` and
``set_servo_setpoint`` of ``external_control.urscript`` in
UniversalRobots/Universal_Robots_Client_Library, commit c5d1e26).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import ConfigError
from fluxvla_core.operators import EmbodimentSpec

Array = npt.NDArray[np.float64]
STREAMED = "forward_position_controller"
"""The controller that works like this; trajectory controllers interpolate by themselves."""
STEP = 20.0 * 0.002
"""How far one position may be from another, in rad."""
# The first that suffices is taken; the robot itself runs at the last.
_RATES_HZ = (125.0, 250.0, 500.0)


def servo_rate(spec: EmbodimentSpec) -> float:
    """How many positions a second let an arm move at full speed."""
    return next(rate for rate in _RATES_HZ if _longest(spec)[1] / rate <= STEP)


def check_rate(spec: EmbodimentSpec) -> None:
    """Refuse to command an arm so rarely that it would ignore what is within its limits.

    Raises:
        ConfigError: at full speed the positions are further apart than the robot takes.
    """
    name, speed = _longest(spec)
    step = speed / spec.rate_hz
    if step > STEP:
        raise ConfigError(
            f"publish_rate {spec.rate_hz:g} Hz: at full speed {name} is commanded {step:.3f} rad "
            f"at a time, and with {STREAMED} the robot ignores more than {STEP:g} rad",
            cause="it moves to each position within 2 ms, and takes no more than 20 rad/s for it",
            next=f"leave publish_rate out, or "
            f"--set <UROperator>.publish_rate={servo_rate(spec):g}; what a policy says "
            "at another rate is interpolated",
        )


def is_taken(target: Array, *near: Array) -> bool:
    """Whether the robot moves to ``target`` ``(6,)``, or ignores it.

    Args:
        near: ``(6,)`` the last position that it took, and where it is; one suffices.
    """
    return any(np.abs(target - position).max() <= STEP for position in near)


def _longest(spec: EmbodimentSpec) -> tuple[str, float]:
    """The fastest joint of the arm and its speed, rad/s."""
    arm = [joint for joint in spec.joints if joint.kind != "gripper"]
    fastest = max(arm, key=lambda joint: joint.velocity)
    return fastest.name, fastest.velocity
