"""Profiles and rotations that the experts move by, and noise that disturbs them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

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
