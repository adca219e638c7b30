"""``WorkspaceBox``: a point of the arm stays in a box, whatever the policy wants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.robot import ActionFilter
from fluxvla_core.errors import ConfigError
from fluxvla_core.robot.filters import Columns, joint_columns
from fluxvla_core.robot.kinematics import Chain, vector
from fluxvla_core.robot.stops import BadCommand
from fluxvla_core.spec.embodiment import EmbodimentSpec

Array = npt.NDArray[np.float64]
# A violation is a fraction of a millimetre as a rule, and gone in two or three rounds.
_ROUNDS = 20
_DAMPING = 1e-4  # m^2/rad^2, keeps steps finite where the arm is stretched
_INSIDE = 1e-6  # m


class WorkspaceBox(ActionFilter):
    """Moves a target whose tool point is outside the box to the wall, along the least joint way.

    The way is found by damped least squares on the chain's Jacobian, so that a motion along a wall
    goes on along it. A target for which that fails is not taken: the arm stays where it was last
    allowed to go. Only the one point is watched: no elbow, no other arm, no object.

    The box holds for targets, and an arm that comes at a wall with speed needs its braking way
    behind it: up to ``v^2 / 2A`` in each joint, which on a UR (pi rad/s^2) is a centimetre at the
    tool at 0.3 m/s and ten at 0.5 m/s. Make the box smaller than the room by that much, or
    ``safety.velocity_scale`` small. The way to the start pose is not boxed.

    Args:
        lower, upper: ``(3,)`` corners in metres, in the frame of the chain's base.
        joints: names of the arm's joints, from base to tool.
        links: the chain as URDF writes it: a table ``dict(xyz=…, rpy=…, axis=…)`` for each joint.
        dh: instead of ``links``: ``(a, d, alpha)`` for each joint, see ``Chain.of_dh``.
        tool: ``(3,)`` the point, in metres, in the frame of the last link (behind it, with ``dh``).

    Raises:
        ConfigError: the box has no inside, or not exactly one of ``links`` and ``dh`` is given, or
            it is not for as many joints as are named.
    """

    def __init__(
        self,
        lower: Sequence[float],
        upper: Sequence[float],
        joints: Sequence[str],
        links: Sequence[Mapping[str, Any]] | None = None,
        dh: Sequence[Sequence[float]] | None = None,
        tool: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        self.lower, self.upper = vector(lower, "lower"), vector(upper, "upper")
        who = type(self).__name__
        if not (self.upper - self.lower > 2 * _INSIDE).all():
            raise ConfigError(f"{who}: lower {list(lower)} is not below upper {list(upper)}")
        if (links is None) == (dh is None):
            raise ConfigError(f"{who}: give links or dh, one of them")
        self.chain = Chain.of_dh(dh, tool) if dh is not None else Chain(links or (), tool)
        if self.chain.dim != len(joints):
            raise ConfigError(f"{who}: {len(joints)} joints are named, {self.chain.dim} described")
        self.joints = tuple(joints)
        self._columns: Columns = np.arange(self.chain.dim)
        self._limits: tuple[Array, Array] = (np.full(1, -np.inf), np.full(1, np.inf))
        self._last: Array | None = None

    def bind(self, embodiment: EmbodimentSpec) -> None:
        """Find the joints; raises ConfigError for one that is not there."""
        known = {name: i for i, name in enumerate(embodiment.joint_names)}
        self._columns = joint_columns(type(self).__name__, self.joints, known)
        named = [embodiment.joints[column] for column in self._columns]
        self._limits = np.array([j.lower for j in named]), np.array([j.upper for j in named])

    def reset(self, pose: Array) -> None:
        """Begin an episode at ``pose``."""
        self._last = np.array(pose, dtype=np.float64)[self._columns]

    def __call__(self, action: Array) -> Array:
        target = np.array(action, dtype=np.float64)
        # What the limits would do to it afterwards counts.
        wanted = np.clip(target[self._columns], *self._limits)
        allowed = self._inside(wanted)
        if allowed is None:
            if self._last is None:
                raise BadCommand(
                    f"{type(self).__name__}: the first target is outside the box, and no near one "
                    "is in it"
                )
            allowed = self._last
        elif allowed is wanted:
            # What the joints' own limits will change is recorded there.
            allowed = target[self._columns]
        self._last = np.clip(allowed, *self._limits)
        target[self._columns] = allowed
        return target

    def _inside(self, joints: Array) -> Array | None:
        """``joints`` if their point is in the box, else near ones whose is, or None."""
        found = joints
        for _ in range(_ROUNDS):
            point, jacobian = self.chain.position_and_jacobian(found)
            if ((self.lower <= point) & (point <= self.upper)).all():
                return found
            way = np.clip(point, self.lower + _INSIDE, self.upper - _INSIDE) - point
            normal = jacobian @ jacobian.T + _DAMPING * np.eye(3)
            found = np.clip(found + jacobian.T @ np.linalg.solve(normal, way), *self._limits)
        return None
