"""A scripted pick for the UR5e: down on the cube, close, up; open loop from the cube's pose."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from fluxvla_ur.embodiment import JOINTS

from fluxvla_sim.ik import ArmIK
from fluxvla_sim.motion import minimum_jerk
from fluxvla_sim.ur.scene import GRIPPER, HOME, load_model

if TYPE_CHECKING:
    import numpy.typing as npt

    Vector = npt.NDArray[np.float64]

TIP = (0.0, 0.0, 0.145)  # the Menagerie's site "pinch", in the gripper base's frame, metres
ABOVE, DOWN, UP = 0.15, 0.02, 0.25  # heights of the fingertips, metres
STEPS = 250

# (until step, height of the fingertips); the cube is under them from the first one on.
_HEIGHTS = ((80, ABOVE), (130, DOWN), (180, DOWN), (240, UP))
_CLOSE = (130, 175)


class URExpert:
    """Plans 250 commands (5 s) that end with the cube in the air."""

    def __init__(self, model: Any = None) -> None:
        model = load_model() if model is None else model
        self._ik = ArmIK(model, JOINTS, f"{GRIPPER}base", TIP)

    def plan(self, cube: Vector) -> Vector:
        """``(250, 7)`` joint targets for the cube's pose ``(7,)`` before the first step."""
        actions = np.tile(HOME, (STEPS, 1))
        joints, start = HOME[:6].copy(), 0
        tip, _ = self._ik.forward(joints)
        # Fingers down; the turn about the vertical is the one at home.
        down = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0])
        for until, height in _HEIGHTS:
            goal = np.array([*cube[:2], height])
            for step, share in enumerate(minimum_jerk(until - start), start):
                joints, _ = self._ik.solve(joints, tip + share * (goal - tip), down)
                actions[step, :6] = joints
            tip, start = goal, until
        actions[start:, :6] = joints
        begin, end = _CLOSE
        actions[begin:end, 6] = 1.0 - minimum_jerk(end - begin)
        actions[end:, 6] = 0.0
        return actions
