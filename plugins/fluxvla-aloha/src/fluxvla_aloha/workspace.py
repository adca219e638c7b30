"""``AlohaWorkspaceBox``: the fingertips of one ViperX 300 stay in a box.

Joint origins and axes are those of ``vx300s.urdf.xacro`` in Interbotix/interbotix_ros_manipulators
(commit 41746ab), which gym-aloha's model has too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from fluxvla_aloha.arms import VIPERX300
from fluxvla_core.errors import ConfigError
from fluxvla_core.operators import WorkspaceBox

# Offset from the joint before in metres, and axis: waist, shoulder, elbow, forearm roll, wrist
# angle, wrist rotation.
LINKS = (
    {"xyz": (0.0, 0.0, 0.079), "axis": (0.0, 0.0, 1.0)},
    {"xyz": (0.0, 0.0, 0.04805), "axis": (0.0, 1.0, 0.0)},
    {"xyz": (0.05955, 0.0, 0.3), "axis": (0.0, 1.0, 0.0)},
    {"xyz": (0.2, 0.0, 0.0), "axis": (1.0, 0.0, 0.0)},
    {"xyz": (0.1, 0.0, 0.0), "axis": (0.0, 1.0, 0.0)},
    {"xyz": (0.069744, 0.0, 0.0), "axis": (1.0, 0.0, 0.0)},
)
FINGERTIPS = (0.15, 0.0, 0.0)
"""Between the fingers, from the gripper's link: gym-aloha's calibration site."""


class AlohaWorkspaceBox(WorkspaceBox):
    """Keeps ``tool`` in a box in the frame of its own arm's base: x forward, y left, z up.

    Args:
        arm: ``left`` or ``right``; a robot with both has two of these filters.
        lower, upper: ``(3,)`` corners in metres.
        tool: ``(3,)`` the point in metres, from the wrist's last joint, x towards the fingertips.
    """

    api: ClassVar[str] = "1.0"

    def __init__(
        self,
        arm: str,
        lower: Sequence[float],
        upper: Sequence[float],
        tool: Sequence[float] = FINGERTIPS,
    ) -> None:
        if arm not in ("left", "right"):
            raise ConfigError(f"AlohaWorkspaceBox: arm is 'left' or 'right', got {arm!r}")
        names = [f"{arm}_{joint.name}" for joint in VIPERX300.joints[:-1]]
        super().__init__(lower, upper, names, links=LINKS, tool=tool)
