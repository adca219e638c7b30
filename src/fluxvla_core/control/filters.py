"""What may alter an action on its way: the ``action_filters`` of a config, in its order.

A filter is ``f(action) -> action`` on one ``(D,)`` target in physical units. It may have
``reset(pose)``, called with the start pose when an episode begins. The limits come after all
filters, so that no filter can undo them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import ConfigError
from fluxvla_core.spec.embodiment import EmbodimentSpec

Array = npt.NDArray[np.float64]


class SnapGripper:
    """Closes a gripper wholly once its target is nearly closed.

    Policies learn the position at which a gripper came to rest on an object; commanding that holds
    it without force.

    Args:
        columns: which columns of the action are grippers.
        threshold: targets nearer to ``closed`` than this become ``closed``.
        closed: the closed value, in the gripper's unit.
    """

    def __init__(
        self, columns: Sequence[int], threshold: float = 0.05, closed: float = 0.0
    ) -> None:
        if not threshold >= 0:
            raise ConfigError(f"SnapGripper: threshold must not be negative, got {threshold}")
        self.columns = tuple(columns)
        self.threshold = threshold
        self.closed = closed

    @classmethod
    def of(cls, embodiment: EmbodimentSpec, threshold: float) -> list[SnapGripper]:
        """One filter for each gripper of an embodiment, with its own polarity."""
        return [
            cls((column,), threshold, joint.closed)
            for column, joint in enumerate(embodiment.joints)
            if joint.closed is not None
        ]

    def __call__(self, action: Array) -> Array:
        snapped = np.array(action, dtype=np.float64)
        for column in self.columns:
            if abs(snapped[column] - self.closed) < self.threshold:
                snapped[column] = self.closed
        return snapped


class LowPass:
    """First-order smoothing: each target moves only a share of the way to the new one.

    Args:
        share: in (0, 1]; 1 changes nothing. At 50 Hz a share of 0.5 delays by 20 ms.
        columns: which columns are smoothed; all by default.
    """

    def __init__(self, share: float, columns: Sequence[int] | None = None) -> None:
        if not 0 < share <= 1:
            raise ConfigError(f"LowPass: share must be above 0 and at most 1, got {share}")
        self.share = share
        self.columns = None if columns is None else list(columns)
        self._last: Array | None = None

    def reset(self, pose: Array) -> None:
        """Begin an episode at ``pose``."""
        self._last = np.array(pose, dtype=np.float64)

    def __call__(self, action: Array) -> Array:
        target = np.array(action, dtype=np.float64)
        if self._last is not None:
            smooth = self._last + self.share * (target - self._last)
            if self.columns is None:
                target = smooth
            else:
                target[self.columns] = smooth[self.columns]
        self._last = target
        return target.copy()
