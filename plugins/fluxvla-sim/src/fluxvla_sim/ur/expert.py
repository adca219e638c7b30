"""A scripted pick for the UR5e: down on the cube, close, up; open loop from the cube's pose."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from fluxvla_ur.embodiment import JOINTS

from fluxvla_sim.ik import ArmIK
from fluxvla_sim.motion import minimum_jerk, slow_noise
from fluxvla_sim.ur.scene import GRIPPER, HOME, MAX_STEPS, load_model

if TYPE_CHECKING:
    import numpy.typing as npt

    Vector = npt.NDArray[np.float64]

TIP = (0.0, 0.0, 0.145)  # the Menagerie's site "pinch", in the gripper base's frame, metres
ABOVE, DOWN, UP = 0.15, 0.02, 0.25  # heights of the fingertips, metres

# (until step, height of the fingertips); the cube is under them from the first one on.
_HEIGHTS = ((80, ABOVE), (128, DOWN), (190, DOWN), (250, UP))
_CLOSE = (128, 186)
_DELICATE = ((85, 190),)


class URExpert:
    """Plans 300 commands (6 s) that end with the cube in the air."""

    def __init__(self, model: Any = None) -> None:
        model = load_model() if model is None else model
        self._ik = ArmIK(model, JOINTS, f"{GRIPPER}base", TIP)

    def plan(self, task: str, objects: Vector) -> Vector:
        """``(300, 7)`` joint targets for the cube's pose ``(7,)`` before the first step."""
        actions = np.tile(HOME, (MAX_STEPS, 1))
        joints, start = HOME[:6].copy(), 0
        tip, _ = self._ik.forward(joints)
        # Fingers down; the turn about the vertical is the one at home.
        down = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0])
        for until, height in _HEIGHTS:
            goal = np.array([*objects[:2], height])
            for step, share in enumerate(minimum_jerk(until - start), start):
                joints, _ = self._ik.solve(joints, tip + share * (goal - tip), down)
                actions[step, :6] = joints
            tip, start = goal, until
        actions[start:, :6] = joints
        begin, end = _CLOSE
        actions[begin:end, 6] = 1.0 - minimum_jerk(end - begin)
        actions[end:, 6] = 0.0
        return actions


def lift_noise(rng: np.random.Generator) -> Vector:
    """``(300, 7)`` offsets of about unit size: slow, smaller where it is delicate, no gripper."""
    return slow_noise(rng, MAX_STEPS, len(HOME), _DELICATE, grippers=(6,))
