"""Action filters: the ``action_filters`` of a config, applied in its order before the limits.

A filter is ``f(action) -> action`` on one ``(D,)`` target in physical units; see
``contracts.ActionFilter``. The limits come after all filters, so that no filter can undo them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.robot import ActionFilter
from fluxvla_core.control.kinematics import Chain, vector
from fluxvla_core.control.safety import BadCommand
from fluxvla_core.errors import ConfigError, nearest
from fluxvla_core.spec import EmbodimentSpec

Array = npt.NDArray[np.float64]
Columns = npt.NDArray[np.intp]
# Of WorkspaceBox. A violation is a fraction of a millimetre as a rule, and gone in a few rounds.
_ROUNDS = 20
_DAMPING = 1e-4  # m^2/rad^2, keeps steps finite where the arm is stretched
_INSIDE = 1e-6  # m


class SnapGripper(ActionFilter):
    """Closes a gripper completely once its target is nearly closed.

    Policies learn the position at which a gripper came to rest on an object; commanding that holds
    it without force.

    Args:
        threshold: targets nearer to ``closed`` than this become ``closed``, in the gripper's unit.
        open_threshold: the same for ``open``; None leaves them as they are.
        joints: names of the grippers; all of the embodiment's by default, each with its polarity.

    Raises:
        ConfigError: a threshold is negative.
    """

    def __init__(
        self,
        threshold: float = 0.05,
        open_threshold: float | None = None,
        joints: Sequence[str] | None = None,
    ) -> None:
        for name, value in (("threshold", threshold), ("open_threshold", open_threshold)):
            if value is not None and not value >= 0:
                raise ConfigError(f"SnapGripper: {name} must not be negative, got {value}")
        self.threshold = threshold
        self.open_threshold = open_threshold
        self.joints = joints
        self._ends: list[tuple[int, float, float]] = []

    def bind(self, embodiment: EmbodimentSpec) -> None:
        """Find the grippers.

        Raises:
            ConfigError: there is none, or a joint that is named is none.
        """
        known = {j.name: i for i, j in enumerate(embodiment.joints) if j.kind == "gripper"}
        if not known:
            raise ConfigError(f"SnapGripper: {embodiment.name} has no gripper")
        columns = joint_columns("SnapGripper", self.joints or list(known), known)
        grippers = [embodiment.joints[column] for column in columns]
        self._ends = [
            (int(column), float(joint.closed or 0.0), float(joint.open or 0.0))
            for column, joint in zip(columns, grippers, strict=True)
        ]

    def __call__(self, action: Array) -> Array:
        snapped = np.array(action, dtype=np.float64)
        for column, closed, opened in self._ends:
            if abs(snapped[column] - closed) < self.threshold:
                snapped[column] = closed
            elif self.open_threshold and abs(snapped[column] - opened) < self.open_threshold:
                snapped[column] = opened
        return snapped


class LowPass(ActionFilter):
    """First-order smoothing: each target moves only a share of the way to the new one.

    Args:
        share: in (0, 1]; 1 changes nothing. At 50 Hz a share of 0.5 delays by 20 ms.
        joints: names of those that are smoothed; all by default.

    Raises:
        ConfigError: ``share`` is out of its range.
    """

    def __init__(self, share: float, joints: Sequence[str] | None = None) -> None:
        if not 0 < share <= 1:
            raise ConfigError(f"LowPass: share must be above 0 and at most 1, got {share}")
        self.share = share
        self.joints = joints
        self._columns: Columns | slice = slice(None)
        self._last: Array | None = None

    def bind(self, embodiment: EmbodimentSpec) -> None:
        """Find the joints; raises ConfigError for one that is not there."""
        if self.joints is not None:
            known = {name: i for i, name in enumerate(embodiment.joint_names)}
            self._columns = joint_columns("LowPass", self.joints, known)

    def reset(self, pose: Array) -> None:
        """Begin an episode at ``pose``."""
        self._last = np.array(pose, dtype=np.float64)

    def __call__(self, action: Array) -> Array:
        target = np.array(action, dtype=np.float64)
        if self._last is not None:
            last = self._last[self._columns]
            target[self._columns] = last + self.share * (target[self._columns] - last)
        self._last = target
        return target.copy()


class WorkspaceBox(ActionFilter):
    """Moves a target whose tool point is outside the box to the wall, along the least joint way.

    The way is found by damped least squares on the chain's Jacobian, so that a motion along a wall
    continues along it. A target for which that fails is not taken: the arm stays where it was last
    allowed to go. Only the one point is watched: no elbow, no other arm, no object.

    The box holds for targets, and an arm that comes at a wall with speed needs its braking way
    behind it: up to ``v^2 / 2A`` in each joint, which on a UR (pi rad/s^2) is a centimetre at the
    tool at 0.3 m/s and ten at 0.5 m/s. Make the box smaller than the allowed space by that much, or
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


def joint_columns(who: str, names: Sequence[str], known: dict[str, int]) -> Columns:
    """Indices ``(len(names),)`` of the joints called ``names`` in an action.

    Raises:
        ConfigError: ``known`` has no such joint; names the nearest.
    """
    for name in names:
        if name not in known:
            near = nearest(str(name), known)
            hint = f"; did you mean {near!r}?" if near else f"; there are {', '.join(known)}"
            raise ConfigError(f"{who}: there is no joint {name!r}{hint}")
    return np.array([known[name] for name in names], dtype=np.intp)
