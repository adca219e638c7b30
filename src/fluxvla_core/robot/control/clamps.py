"""Clamps: the values of a command that a limit changed, or would have changed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fluxvla_core.spec.embodiment import EmbodimentSpec

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Clamp:
    """One joint of one command that was not sent as wanted.

    ``reason`` is the first rule that the wanted value breaks: ``position`` (it lies beyond a
    limit), ``velocity`` (it is too far for one period), ``braking`` (going there, the arm could not
    stop before a limit), ``acceleration``, or ``jerk``. Values are in the joint's unit.
    """

    joint: str
    wanted: float
    given: float
    reason: str


class PassThrough:
    """No limits, for actions that are no joint targets: commands are the targets.

    What such an environment does with a value beyond its limits is up to it; it is recorded.

    Args:
        embodiment: gives the limits that the values are compared with.
    """

    def __init__(self, embodiment: EmbodimentSpec) -> None:
        self.embodiment = embodiment
        self._lower: Array = np.array([joint.lower for joint in embodiment.joints])
        self._upper: Array = np.array([joint.upper for joint in embodiment.joints])

    def run(self, wanted: npt.ArrayLike, speed: float = 1.0) -> tuple[Array, list[list[Clamp]]]:
        """``(N, D)`` targets as they are, and a ``Clamp`` for each value beyond its limits."""
        rows = np.asarray(wanted, dtype=np.float64)
        slack = 1e-6 * (self._upper - self._lower)
        beyond = (rows > self._upper + slack) | (rows < self._lower - slack)
        return rows, [self._noted(row, found) for row, found in zip(rows, beyond, strict=True)]

    def _noted(self, row: Array, beyond: npt.NDArray[np.bool_]) -> list[Clamp]:
        names = self.embodiment.joint_names
        values = [(names[index], float(row[index])) for index in np.flatnonzero(beyond)]
        return [Clamp(name, value, value, "position") for name, value in values]
