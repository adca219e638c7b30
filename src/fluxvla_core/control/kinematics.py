"""Forward kinematics of a point on a chain of revolute joints, and its Jacobian.

A chain is written as URDF writes it, joint by joint: where the joint's frame is in the one before
(``xyz`` in metres, ``rpy`` in radians, rotations about the fixed axes x, y, z in that order) and
about which of its axes it turns. ``of_dh`` makes one of Denavit-Hartenberg rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import ConfigError

Array = npt.NDArray[np.float64]
Vector = Sequence[float]


@dataclass(frozen=True)
class Link:
    """One revolute joint: its frame in the one before, and its axis in its own frame."""

    xyz: Vector = (0.0, 0.0, 0.0)
    rpy: Vector = (0.0, 0.0, 0.0)
    axis: Vector = (0.0, 0.0, 1.0)


class Chain:
    """A point of an arm as a function of its joints.

    Args:
        links: from the base to the last joint, as ``Link`` or as tables of its fields.
        tool: ``(3,)`` the point, in the last joint's frame.

    Raises:
        ConfigError: there is no link, or a row has other fields, or not three finite numbers.
    """

    def __init__(
        self, links: Sequence[Link | Mapping[str, Any]], tool: Vector = (0.0, 0.0, 0.0)
    ) -> None:
        if not links:
            raise ConfigError("a chain needs at least one link")
        rows = [link if isinstance(link, Link) else _link(link) for link in links]
        self._offsets = [vector(row.xyz, "xyz") for row in rows]
        self._rotations = [_rpy(vector(row.rpy, "rpy")) for row in rows]
        axes = [vector(row.axis, "axis") for row in rows]
        if not all(axis.any() for axis in axes):
            raise ConfigError("an axis of a chain has no length")
        self._axes = [axis / np.linalg.norm(axis) for axis in axes]
        self._tool = vector(tool, "tool")

    @classmethod
    def of_dh(cls, rows: Sequence[Vector], tool: Vector = (0.0, 0.0, 0.0)) -> Chain:
        """From ``(a, d, alpha)`` of each joint (m, m, rad), in the original convention:

            T_i = RotZ(theta_i) TransZ(d_i) TransX(a_i) RotX(alpha_i)

        Args:
            rows: one for each joint.
            tool: ``(3,)`` the point, in the frame behind the last row (a UR's flange).
        """
        links, offset, turn = [], np.zeros(3), 0.0
        for a, d, alpha in (vector(row, "dh") for row in rows):
            links.append(Link(tuple(offset), (turn, 0.0, 0.0)))
            offset, turn = np.array([a, 0.0, d]), float(alpha)
        end = offset + _rpy(np.array([turn, 0.0, 0.0])) @ vector(tool, "tool")
        return cls(links, tuple(end))

    @property
    def dim(self) -> int:
        """How many joints it has."""
        return len(self._axes)

    def position(self, joints: npt.ArrayLike) -> Array:
        """``(3,)`` metres in the base's frame, for ``(dim,)`` joint angles in radians."""
        return self.position_and_jacobian(joints)[0]

    def position_and_jacobian(self, joints: npt.ArrayLike) -> tuple[Array, Array]:
        """``(3,)`` position, and ``(3, dim)`` how it changes with each joint, in m/rad."""
        place, turn = np.zeros(3), np.eye(3)
        origins, axes = [], []
        angles = np.asarray(joints, dtype=np.float64)
        for offset, rotation, axis, angle in zip(
            self._offsets, self._rotations, self._axes, angles, strict=True
        ):
            place = place + turn @ offset
            turn = turn @ rotation
            origins.append(place)
            axes.append(turn @ axis)
            turn = turn @ _about(axis, float(angle))
        point: Array = place + turn @ self._tool
        jacobian: Array = np.cross(axes, point - np.array(origins)).T
        return point, jacobian


def vector(values: Any, what: str) -> Array:
    """``(3,)`` float64.

    Raises:
        ConfigError: it is something else.
    """
    try:
        found = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        found = np.empty(0)
    if found.shape != (3,) or not np.isfinite(found).all():
        raise ConfigError(f"{what} must be three numbers, got {values!r}")
    return found


def _link(table: Mapping[str, Any]) -> Link:
    try:
        return Link(**table)
    except TypeError as error:
        raise ConfigError(f"a link has xyz, rpy and axis, got {dict(table)!r}") from error


def _rpy(angles: Array) -> Array:
    x, y, z = np.eye(3)
    roll, pitch, yaw = (float(angle) for angle in angles)
    turn: Array = _about(z, yaw) @ _about(y, pitch) @ _about(x, roll)
    return turn


def _about(axis: Array, angle: float) -> Array:
    """Rodrigues' rotation about a unit vector."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turn: Array = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)
    return turn
