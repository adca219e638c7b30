"""ALOHA: two ViperX 300 6-DOF arms with grippers, 14 numbers in, 14 numbers out.

Limits of the arm joints are those of the manufacturer's URDF, ``vx300s.urdf.xacro`` in
Interbotix/interbotix_ros_manipulators (commit 41746ab): positions in degrees there, speed pi rad/s.

The URDF has no acceleration limit and the same project's MoveIt configuration plans with a
cautious 5 rad/s^2, which teleoperated demonstrations exceed all the time. 20 rad/s^2 is what the
URDF's efforts allow an outstretched, unloaded arm: its links and gripper make about 0.38 kg m^2
about the shoulder and weigh 7.5 N m on it, so the shoulder's 20 N m give (20 - 7.5) / 0.38 = 33 and
the waist's 10 N m give 26 rad/s^2. From full speed the arm comes to rest in 0.16 s. Heavy loads
want less: ``safety=dict(acceleration_scale=0.4)`` in the inference section.

Grippers are normalised, 0 closed and 1 open (finger travel 21 to 57 mm in the URDF). Their speed is
the XM430-W350 servo's no-load 46 rev/min at 12 V (Robotis e-Manual) over the 2.11 rad that ALOHA
scales to 0..1, which is 2.28/s; the acceleration reaches it in 0.08 s.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import pi, radians

from fluxvla_core.spec.embodiment import Camera, EmbodimentSpec, Joint

SOURCE = "Interbotix vx300s.urdf.xacro @41746ab; accelerations as fluxvla_aloha.embodiment argues"
RATE_HZ = 50.0
ARM_VELOCITY = pi
ARM_ACCELERATION = 20.0
GRIPPER_VELOCITY = 2.28
GRIPPER_ACCELERATION = 30.0

# The URDF keeps continuous joints a hair inside the half turn, and so do we.
_TURN = pi - 1e-5
ARM_RANGES: dict[str, tuple[float, float]] = {
    "waist": (-_TURN, _TURN),
    "shoulder": (radians(-106), radians(72)),
    "elbow": (radians(-101), radians(92)),
    "forearm_roll": (-_TURN, _TURN),
    "wrist_angle": (radians(-107), radians(128)),
    "wrist_rotate": (-_TURN, _TURN),
}

CAMERAS = (
    Camera("cam_high", 480, 640),
    Camera("cam_left_wrist", 480, 640),
    Camera("cam_right_wrist", 480, 640),
)

START_POSE: tuple[float, ...] = (0.0, -0.96, 1.16, 0.0, -0.3, 0.0, 1.0) * 2
"""Both arms up and back, grippers open: where ALOHA's own scripts begin; rad and 0..1."""

GRIPPERS: tuple[int, ...] = (6, 13)
"""Columns of the two grippers."""


def arm_joints(side: str) -> tuple[Joint, ...]:
    """The seven joints of one arm, named ``<side>_waist`` … ``<side>_gripper``."""
    joints = tuple(
        Joint(f"{side}_{name}", "rad", lower, upper, ARM_VELOCITY, ARM_ACCELERATION)
        for name, (lower, upper) in ARM_RANGES.items()
    )
    gripper = Joint(
        f"{side}_gripper",
        "normalized",
        0.0,
        1.0,
        GRIPPER_VELOCITY,
        GRIPPER_ACCELERATION,
        kind="gripper",
        open=1.0,
        closed=0.0,
    )
    return (*joints, gripper)


def aloha_spec(cameras: Sequence[Camera] = CAMERAS, rate_hz: float = RATE_HZ) -> EmbodimentSpec:
    """The embodiment of an ALOHA: left arm, then right arm, absolute joint targets.

    Args:
        cameras: the image streams there are, in the order of the images.
        rate_hz: commands a second.
    """
    return EmbodimentSpec(
        name="aloha",
        joints=(*arm_joints("left"), *arm_joints("right")),
        cameras=tuple(cameras),
        rate_hz=rate_hz,
        source=SOURCE,
    )
