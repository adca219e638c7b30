"""What may alter an action on its way: the ``action_filters`` of a config, in its order.

A filter is ``f(action) -> action`` on one ``(D,)`` target in physical units; see
``contracts.ActionFilter``. The limits come after all filters, so that no filter can undo them.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.robot import ActionFilter
from fluxvla_core.errors import ConfigError
from fluxvla_core.spec.embodiment import EmbodimentSpec

Array = npt.NDArray[np.float64]
Columns = npt.NDArray[np.intp]


def bind_filters(filters: Iterable[ActionFilter], embodiment: EmbodimentSpec) -> None:
    """Tell every filter that wants to know which robot it is for.

    Raises:
        ConfigError: one of them does not fit it.
    """
    for each in filters:
        each.bind(embodiment)


class SnapGripper(ActionFilter):
    """Closes a gripper wholly once its target is nearly closed.

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


def joint_columns(who: str, names: Sequence[str], known: dict[str, int]) -> Columns:
    """Where in an action the joints called ``names`` are: ``(len(names),)`` indices.

    Raises:
        ConfigError: ``known`` has no such joint; names the nearest.
    """
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(str(name), known, 1)
            hint = f"; did you mean {near[0]!r}?" if near else f"; there are {', '.join(known)}"
            raise ConfigError(f"{who}: there is no joint {name!r}{hint}")
    return np.array([known[name] for name in names], dtype=np.intp)
