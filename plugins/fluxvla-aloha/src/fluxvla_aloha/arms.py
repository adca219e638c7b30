"""The arms that ALOHAs are built with, and their limits: ViperX 300, ARX X5, AgileX PiPER.

**ViperX 300** (6 DOF). Limits of the arm joints are those of the manufacturer's URDF,
``vx300s.urdf.xacro`` in Interbotix/interbotix_ros_manipulators (commit 41746ab): positions in
degrees there, speed pi rad/s. It has no acceleration limit and the same project's MoveIt
configuration plans with a cautious 5 rad/s^2, which teleoperated demonstrations exceed all the
time. 20 rad/s^2 is what the URDF's efforts allow an outstretched, unloaded arm: its links and
gripper make about 0.38 kg m^2 about the shoulder and weigh 7.5 N m on it, so the shoulder's 20 N m
give (20 - 7.5) / 0.38 = 33 and the waist's 10 N m give 26 rad/s^2. From full speed the arm comes to
rest in 0.16 s. Heavy loads want less: ``safety=dict(acceleration_scale=0.4)`` in the inference
section. The gripper's speed is the XM430-W350 servo's no-load 46 rev/min at 12 V (Robotis
e-Manual) over the 2.11 rad that ALOHA scales to 0..1, which is 2.28/s.

**ARX X5**. Two sources, and of each limit the narrower: the manufacturer's URDF of 2025
(``X5/X5-2025.7z`` in ARXroboticsX/ARX_Model, commit 6c1537f) and, for arms from before,
``include/app/config.h`` and ``models/X5.urdf`` of real-stanford/arx5-sdk (commit 79240ef), which
drives them through the manufacturer's library. Neither has an acceleration limit; as for UR arms,
a joint may take one second from full speed to rest. The gripper's jaws move their 44 mm at 53 mm/s
(``AC one.7z`` in ARX_Model), which is 1.2/s.

**AgileX PiPER**. Positions and speed are those of ``CHANGELOG.MD`` and ``INTERFACE_V2.MD`` in
agilexrobotics/piper_sdk (commit 1dadd60), the acceleration the largest that the latter lets a
joint be set to. Its driver gives the gripper's opening in metres, 0.07 at most. No source gives
the gripper's speed; the slowest of the others is used.

Grippers are normalised, 0 closed and 1 open, and reach their speed in 0.08 s.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import pi, radians

from fluxvla_core.errors import ConfigError
from fluxvla_core.operators import Joint


@dataclass(frozen=True)
class Arms:
    """One kind of arm; an ALOHA has two of them.

    Args:
        robot: name of the embodiment.
        source: where the limits come from.
        joints: of one arm, six and the gripper, without its side.
        start: ``(7,)`` a pose to begin from, gripper open.
        gripper_ends: raw values of the closed and the open gripper in this arm's messages; None
            where they are the preset's.
    """

    robot: str
    source: str
    joints: tuple[Joint, ...]
    start: tuple[float, ...]
    gripper_ends: tuple[float, float] | None = None


def _gripper(speed: float, acceleration: float) -> Joint:
    return Joint(
        "gripper", "normalized", 0.0, 1.0, speed, acceleration, "gripper", open=1.0, closed=0.0
    )


def _joints(
    ranges: Mapping[str, tuple[float, float]],
    speeds: Sequence[float],
    accelerations: Sequence[float],
) -> tuple[Joint, ...]:
    return tuple(
        Joint(name, "rad", lower, upper, speed, acceleration)
        for (name, (lower, upper)), speed, acceleration in zip(
            ranges.items(), speeds, accelerations, strict=True
        )
    )


# The URDF keeps continuous joints a hair inside the half turn, and so do we.
_TURN = pi - 1e-5
VIPERX300 = Arms(
    robot="aloha",
    source="Interbotix vx300s.urdf.xacro @41746ab; accelerations as fluxvla_aloha.arms argues",
    joints=(
        *_joints(
            {
                "waist": (-_TURN, _TURN),
                "shoulder": (radians(-106), radians(72)),
                "elbow": (radians(-101), radians(92)),
                "forearm_roll": (-_TURN, _TURN),
                "wrist_angle": (radians(-107), radians(128)),
                "wrist_rotate": (-_TURN, _TURN),
            },
            speeds=[pi] * 6,
            accelerations=[20.0] * 6,
        ),
        _gripper(2.28, 30.0),
    ),
    # Up and back: where ALOHA's own scripts begin.
    start=(0.0, -0.96, 1.16, 0.0, -0.3, 0.0, 1.0),
)

_X5_SPEEDS = (5.0, 5.0, 5.5, 5.5, 5.0, 5.0)
ARX_X5 = Arms(
    robot="aloha_arx_x5",
    source="ARX X5-2025 URDF @6c1537f, arx5-sdk @79240ef; fluxvla_aloha.arms says which",
    joints=(
        *_joints(
            {
                "x5_joint1": (-2.094, 2.618),
                "x5_joint2": (0.0, 3.14),
                "x5_joint3": (0.0, 3.14),
                "x5_joint4": (-1.57, 1.55),
                "x5_joint5": (-1.57, 1.57),
                "x5_joint6": (-1.57, 1.57),
            },
            speeds=_X5_SPEEDS,
            accelerations=_X5_SPEEDS,
        ),
        _gripper(1.2, 15.0),
    ),
    # Folded: where cobot_magic's inference.py begins.
    start=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
)

PIPER = Arms(
    robot="aloha_piper",
    source="agilexrobotics/piper_sdk CHANGELOG.MD and INTERFACE_V2.MD @1dadd60",
    joints=(
        *_joints(
            {
                "piper_joint1": (-2.6179, 2.6179),
                "piper_joint2": (0.0, 3.14),
                "piper_joint3": (-2.967, 0.0),
                "piper_joint4": (-1.745, 1.745),
                "piper_joint5": (-1.22, 1.22),
                "piper_joint6": (-2.09439, 2.09439),
            },
            speeds=[3.0] * 6,
            accelerations=[5.0] * 6,
        ),
        _gripper(1.2, 15.0),
    ),
    # Folded: the zero of all its joints.
    start=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
    gripper_ends=(0.0, 0.07),
)

ARMS: Mapping[str, Arms] = {"viperx300": VIPERX300, "arx_x5": ARX_X5, "piper": PIPER}


def arms_called(name: str) -> Arms:
    """The arms of this name.

    Raises:
        ConfigError: there are none; names those that there are.
    """
    found = ARMS.get(name)
    if found is None:
        raise ConfigError(f"unknown arms {name!r}; known are {', '.join(ARMS)}")
    return found
