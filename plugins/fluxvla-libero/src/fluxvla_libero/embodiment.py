"""LIBERO's embodiment: a Panda arm moved by pose deltas, seen from two cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from fluxvla_core.operators import Camera, EmbodimentSpec, Joint

if TYPE_CHECKING:
    import numpy.typing as npt

CONTROL_HZ = 20.0
ACTION_DIM = 7
STATE_DIM = 8
OPEN, CLOSED = -1.0, 1.0
"""The gripper's command; only its sign counts."""

CAMERAS = {
    "agentview": "agentview",
    "agentview_image": "agentview",
    "image": "agentview",
    "robot0_eye_in_hand": "robot0_eye_in_hand",
    "robot0_eye_in_hand_image": "robot0_eye_in_hand",
    "wrist_image": "robot0_eye_in_hand",
    "image2": "robot0_eye_in_hand",
}
"""Names that policies and public datasets give LIBERO's two cameras -> the scene's own."""

SCENE_CAMERAS = ("agentview", "robot0_eye_in_hand")
IMAGE_SIZE = 224
"""Side of the images of the standard protocol, in pixels."""

NO_OP = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, OPEN])


def libero_spec(cameras: Sequence[Camera] | None = None) -> EmbodimentSpec:
    """LIBERO's Panda.

    Actions are deltas of the gripper's pose for one control step of robosuite's OSC_POSE
    controller: three of position (1 is 0.05 m) and an axis-angle rotation (length 1 is 0.5 rad),
    along the world's axes, and the gripper's command. The state is the gripper's pose in the
    world, its rotation as axis times angle, and the positions of both fingers. Limits are those
    of the controller's configuration in robosuite 1.4 and of the Panda gripper's model.

    Args:
        cameras: the two of the scene at 224 x 224 by default.
    """
    if cameras is None:
        cameras = [Camera(name, IMAGE_SIZE, IMAGE_SIZE) for name in SCENE_CAMERAS]
    return EmbodimentSpec(
        name="libero_panda",
        joints=(
            *(_delta(name, "prismatic") for name in ("dx", "dy", "dz")),
            *(_delta(name, "revolute") for name in ("drx", "dry", "drz")),
            replace(_delta("gripper", "gripper"), open=OPEN, closed=CLOSED),
        ),
        cameras=tuple(cameras),
        rate_hz=CONTROL_HZ,
        action_mode="delta",
        frame="world",
        rotation="axis_angle",
        source="robosuite 1.4 OSC_POSE controller and PandaGripper; LIBERO's observations",
        state_joints=(
            *(Joint(name, "m", -2.0, 2.0, 2.0, 20.0, "prismatic") for name in ("x", "y", "z")),
            *(Joint(name, "rad", -6.3, 6.3, 5.0, 50.0) for name in ("rx", "ry", "rz")),
            Joint("finger_1", "m", -0.01, 0.05, 0.2, 10.0, "gripper", open=0.04, closed=0.0),
            Joint("finger_2", "m", -0.05, 0.01, 0.2, 10.0, "gripper", open=-0.04, closed=0.0),
        ),
    )


def dataset_spec() -> EmbodimentSpec:
    """:func:`libero_spec` with each camera under every name that datasets give it."""
    return libero_spec([Camera(name, IMAGE_SIZE, IMAGE_SIZE) for name in CAMERAS])


def _delta(name: str, kind: str) -> Joint:
    ends = (OPEN, CLOSED) if kind == "gripper" else (None, None)
    return Joint(name, "normalized", -1.0, 1.0, 40.0, 1600.0, kind, *ends)


def axis_angle(quaternion: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Axis times angle, ``(3,)`` rad, of a unit quaternion in x, y, z, w order.

    As robosuite's ``quat2axisangle`` does it, and so the public datasets: the angle is between 0
    and 2 pi and follows the quaternion's sign. The shortest rotation would be another number for
    the same pose, and a policy trained on one fails on the other.
    """
    x, y, z, w = np.asarray(quaternion, dtype=np.float64)
    w = min(1.0, max(-1.0, w))
    sine = math.sqrt(1.0 - w * w)
    if math.isclose(sine, 0.0, abs_tol=1e-9):
        return np.zeros(3)
    return np.array([x, y, z]) * (2.0 * math.acos(w) / sine)
