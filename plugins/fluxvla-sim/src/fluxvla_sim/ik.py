"""Inverse kinematics of one arm: damped least squares on the pose of its fingertips."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from fluxvla_sim.render import import_mujoco

if TYPE_CHECKING:
    import numpy.typing as npt

    Vector = npt.NDArray[np.float64]


class ArmIK:
    """Joint angles for a pose of the fingertips.

    The step is ``J^T (J J^T + damping I)^-1 e``, the damped least squares of Wampler (1986) and
    Nakamura and Hanafusa (1986), with rotation weighted less than position.

    Args:
        model: ``mujoco.MjModel``.
        joints: names of the arm's joints, from the base on.
        body: name of the body that carries the fingers.
        tip: ``(3,)`` the point between the fingertips in that body's frame, in metres.
    """

    DAMPING = 1e-4
    ROTATION_WEIGHT = 0.3
    MAX_STEP = 0.2  # radians in one iteration
    POSITION_TOLERANCE = 1e-6  # metres
    ROTATION_TOLERANCE = 1e-5  # radians

    def __init__(self, model: Any, joints: Sequence[str], body: str, tip: Sequence[float]) -> None:
        self._mujoco = import_mujoco()
        self._model = model
        self._data = self._mujoco.MjData(model)
        self._body = model.body(body).id
        self._tip = np.array(tip)
        found = [model.joint(name) for name in joints]
        self._dof = np.array([j.dofadr[0] for j in found])
        self._address = np.array([j.qposadr[0] for j in found])
        self._lower, self._upper = np.array([j.range for j in found]).T

    def forward(self, joints: Vector) -> tuple[Vector, Vector]:
        """Fingertip position ``(3,)`` in metres and quaternion wxyz ``(4,)``, world frame."""
        self._data.qpos[self._address] = joints
        self._mujoco.mj_kinematics(self._model, self._data)
        self._mujoco.mj_comPos(self._model, self._data)
        rotation = self._data.xmat[self._body].reshape(3, 3)
        return self._data.xpos[self._body] + rotation @ self._tip, self._data.xquat[
            self._body
        ].copy()

    def solve(
        self, start: Vector, position: Vector, quaternion: Vector, iterations: int = 50
    ) -> tuple[Vector, float]:
        """The solution near ``start``, and how far off its position is.

        Args:
            start: ``(n,)`` joint angles to begin from; they choose the branch.
            position, quaternion: the wanted fingertip pose, as :meth:`forward` gives it.

        Returns:
            ``(n,)`` joint angles within the joint limits, and the position error in metres.
        """
        mujoco, joints = self._mujoco, np.array(start, dtype=np.float64)
        jacobian = np.zeros((6, self._model.nv))
        error, away, turn = np.zeros(6), np.zeros(4), np.zeros(4)
        weight = np.array([1.0, 1.0, 1.0, *[self.ROTATION_WEIGHT] * 3])
        for _ in range(iterations):
            tip, rotation = self.forward(joints)
            error[:3] = position - tip
            mujoco.mju_negQuat(away, rotation)
            mujoco.mju_mulQuat(turn, quaternion, away)
            mujoco.mju_quat2Vel(error[3:], turn, 1.0)
            if (
                np.linalg.norm(error[:3]) < self.POSITION_TOLERANCE
                and np.linalg.norm(error[3:]) < self.ROTATION_TOLERANCE
            ):
                break
            mujoco.mj_jac(self._model, self._data, jacobian[:3], jacobian[3:], tip, self._body)
            j = jacobian[:, self._dof] * weight[:, None]
            step = j.T @ np.linalg.solve(j @ j.T + self.DAMPING * np.eye(6), weight * error)
            joints += np.clip(step, -self.MAX_STEP, self.MAX_STEP)
            joints = np.clip(joints, self._lower, self._upper)
        tip, _ = self.forward(joints)
        return joints, float(np.linalg.norm(position - tip))
