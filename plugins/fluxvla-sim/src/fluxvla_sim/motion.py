"""How experts move an arm: profiles, rotations, noise, and inverse kinematics of its fingertips."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from fluxvla_sim.render import import_mujoco

if TYPE_CHECKING:
    import numpy.typing as npt

    Vector = npt.NDArray[np.float64]

_DELICATE_SHARE = 0.25
_KNOT_STEPS = 25  # between independent offsets; linear in between
_BLEND = 11  # steps over which the offsets' size changes


def minimum_jerk(steps: int) -> Vector:
    """Share of the way after each of ``steps`` steps: ``10 s^3 - 15 s^4 + 6 s^5``, up to 1.

    Flash and Hogan (1985): starts and ends at rest, with no jump of the acceleration.
    """
    s = np.arange(1, steps + 1) / steps
    return s**3 * (10 - 15 * s + 6 * s**2)


def turn(axis: tuple[float, float, float], degrees: float) -> Vector:
    """Quaternion wxyz of a turn about the unit vector ``axis``."""
    half = np.deg2rad(degrees) / 2
    return np.array([np.cos(half), *(np.sin(half) * np.array(axis))])


def quaternion_product(a: Vector, b: Vector) -> Vector:
    """Hamilton product of quaternions wxyz: first turn by ``b``, then by ``a``."""
    w, v = a[0] * b[0] - a[1:] @ b[1:], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])
    return np.array([w, *v])


def slow_noise(
    rng: np.random.Generator,
    steps: int,
    dim: int,
    delicate: Sequence[tuple[int, int]],
    grippers: Sequence[int],
) -> Vector:
    """Offsets of about unit size that an arm can follow.

    Args:
        delicate: (first, last) steps in which they are a quarter as large.
        grippers: columns that stay 0.

    Returns:
        ``(steps, dim)``; the first one continues from rest.
    """
    knots = rng.standard_normal((steps // _KNOT_STEPS + 2, dim))
    at = np.arange(steps) / _KNOT_STEPS
    lines = [np.interp(at, np.arange(len(knots)), knots[:, joint]) for joint in range(dim)]
    size = np.ones(steps)
    for first, last in delicate:
        size[first:last] = _DELICATE_SHARE
    padded = np.pad(size, _BLEND // 2, mode="edge")
    size = np.convolve(padded, np.full(_BLEND, 1 / _BLEND), "valid")
    offsets = np.stack(lines, axis=1) * size[:, None]
    offsets[:, list(grippers)] = 0.0
    offsets[:_BLEND] *= np.linspace(0, 1, _BLEND)[:, None]
    return offsets


def quaternion_share(quaternion: Vector, share: float) -> Vector:
    """``share`` of the turn that the unit ``quaternion`` wxyz is, the short way round."""
    if quaternion[0] < 0:
        quaternion = -quaternion
    sine = np.linalg.norm(quaternion[1:])
    if sine < 1e-12:
        return np.array([1.0, 0.0, 0.0, 0.0])
    half = share * np.arctan2(sine, quaternion[0])
    return np.array([np.cos(half), *(np.sin(half) / sine * quaternion[1:])])


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
