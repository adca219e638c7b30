"""``URWorkspaceBox``: a point of a UR arm stays in a box.

Denavit-Hartenberg parameters are Universal Robots' own, "DH Parameters for calculations of
kinematics and dynamics" (universal-robots.com, articles, Jan 2022). Each arm's calibration differs
from them by a millimetre or so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import pi
from typing import ClassVar

from fluxvla_core.errors import ConfigError
from fluxvla_core.operators import WorkspaceBox
from fluxvla_ur.embodiment import JOINTS

# (d1, a2, a3, d4, d5, d6) in metres; the other lengths are 0, the twists the same for all.
LENGTHS: Mapping[str, tuple[float, ...]] = {
    "ur3e": (0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921),
    "ur5e": (0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996),
    "ur10e": (0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655),
}


def dh_rows(model: str) -> list[tuple[float, float, float]]:
    """``(a, d, alpha)`` of each joint, in metres and radians.

    Raises:
        ConfigError: there is no such model here.
    """
    if model not in LENGTHS:
        raise ConfigError(f"unknown UR model {model!r}; known are {', '.join(LENGTHS)}")
    d1, a2, a3, d4, d5, d6 = LENGTHS[model]
    return [
        (0.0, d1, pi / 2),
        (a2, 0.0, 0.0),
        (a3, 0.0, 0.0),
        (0.0, d4, pi / 2),
        (0.0, d5, -pi / 2),
        (0.0, d6, 0.0),
    ]


class URWorkspaceBox(WorkspaceBox):
    """Keeps ``tool`` in a box in the frame that the teach pendant calls Base.

    ROS's ``base_link`` is turned against that by half a turn about z.

    Args:
        lower, upper: ``(3,)`` corners in metres.
        tool: ``(3,)`` the point in metres, from the flange, z pointing out of it: the tips of a
            closed Robotiq 2F-85 are at about ``(0, 0, 0.163)``.
        model: ``ur3e``, ``ur5e`` or ``ur10e``.
    """

    api: ClassVar[str] = "1.0"

    def __init__(
        self,
        lower: Sequence[float],
        upper: Sequence[float],
        tool: Sequence[float],
        model: str = "ur5e",
    ) -> None:
        super().__init__(lower, upper, JOINTS, dh=dh_rows(model), tool=tool)
