"""Profiles and rotations that the experts move by."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    Vector = npt.NDArray[np.float64]


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
