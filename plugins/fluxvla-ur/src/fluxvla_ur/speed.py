"""What the teach pendant's speed slider means for commands that do not know of it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import Faulted

Array = npt.NDArray[np.float64]
PAUSED = 0.01
"""Speed scaling below which the robot counts as paused."""


def check_not_paused(scaling: float) -> None:
    """Refuse to command a robot that stands still until a person lets it go on.

    Args:
        scaling: share of the programmed speed that the robot runs at, 0 to 1.

    Raises:
        Faulted: it is paused; the commands would wait, and then be a jump.
    """
    if scaling < PAUSED:
        raise Faulted(
            "the robot is paused: its speed scaling is 0",
            cause="the speed slider is at 0, or a safeguard stop is active",
            next="look at the teach pendant",
        )


def scaled_step(before: Array, wanted: Array, speeds: Array, seconds: float) -> Array:
    """``wanted``, or as far towards it as ``speeds`` allow in ``seconds``, on the straight line.

    All joints are slowed down alike, so that the path stays what the policy meant.

    Args:
        before, wanted: ``(D,)`` positions.
        speeds: ``(D,)`` largest speeds, in the positions' units a second.
        seconds: time for the step, already scaled.
    """
    step = wanted - before
    share = np.max(np.abs(step) / (speeds * seconds))
    moved: Array = wanted if share <= 1.0 else before + step / share
    return moved
