"""Universal Robots UR3e, UR5e and UR10e with one gripper: 7 numbers in, 7 numbers out.

Positions and speeds are those of ``config/<model>/joint_limits.yaml`` in
UniversalRobots/Universal_Robots_ROS2_Description (commits 1c32d8f and 8ef39b3), which cite the
e-Series user manuals, version 5.8. The elbow is kept to half its turn there: the upper arm is in
the way of the rest.

The manufacturer publishes no acceleration limit. The description plans the UR5e with 180 deg/s^2;
the same value is used for all three here, which stops a joint at 180 deg/s in one second. It is
what the arm is asked for, not what its own controller would refuse.

The gripper is normalised, 0 closed and 1 open. A Robotiq 2F-85 moves its 85 mm at 20 to 150 mm/s
(its instruction manual, specifications); at 150 mm/s that is 1.76/s.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import radians

from fluxvla_core.errors import ConfigError
from fluxvla_core.operators import Camera, EmbodimentSpec, Joint

JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
# Largest speed of each joint in deg/s, in the order of JOINTS.
SPEEDS: Mapping[str, tuple[int, ...]] = {
    "ur3e": (180, 180, 180, 360, 360, 360),
    "ur5e": (180, 180, 180, 180, 180, 180),
    "ur10e": (120, 120, 180, 180, 180, 180),
}
ACCELERATION = radians(180)
GRIPPER_VELOCITY = 1.76
GRIPPER_ACCELERATION = 20.0
RATE_HZ = 30.0
CAMERAS = (Camera("cam_high", 480, 640), Camera("cam_left_wrist", 480, 640))
SOURCE = "Universal_Robots_ROS2_Description joint_limits.yaml @1c32d8f, @8ef39b3"

GRIPPERS: tuple[int, ...] = (6,)
"""Column of the gripper."""


def ur_spec(
    model: str = "ur5e", cameras: Sequence[Camera] = CAMERAS, rate_hz: float = RATE_HZ
) -> EmbodimentSpec:
    """The embodiment of one arm and its gripper, absolute joint targets.

    Args:
        model: ``ur3e``, ``ur5e`` or ``ur10e``.
        cameras: the image streams there are, in the order of the images.
        rate_hz: commands a second.

    Raises:
        ConfigError: there is no such model here.
    """
    speeds = SPEEDS.get(model)
    if speeds is None:
        raise ConfigError(f"unknown UR model {model!r}; known are {', '.join(SPEEDS)}")
    joints = []
    for name, speed in zip(JOINTS, speeds, strict=True):
        reach = radians(180) if name == "elbow_joint" else radians(360)
        joints.append(Joint(name, "rad", -reach, reach, radians(speed), ACCELERATION))
    gripper = Joint(
        "gripper",
        "normalized",
        0.0,
        1.0,
        GRIPPER_VELOCITY,
        GRIPPER_ACCELERATION,
        kind="gripper",
        open=1.0,
        closed=0.0,
    )
    return EmbodimentSpec(
        name=model,
        joints=(*joints, gripper),
        cameras=tuple(cameras),
        rate_hz=rate_hz,
        source=SOURCE,
    )
