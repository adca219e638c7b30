"""Actions as they may be sent: checked before any I/O, and the one that holds an arm."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import Rejected
from fluxvla_core.spec.embodiment import EmbodimentSpec

Array = npt.NDArray[np.float64]
# A joint further than this from its last command (rad or m) is held where it is: it was blocked,
# and pushing on would not be a stop.
HOLD_REACH = 0.15


def checked_action(embodiment: EmbodimentSpec, action: npt.ArrayLike) -> Array:
    """A fresh ``(dim,)`` float64 copy of ``action``.

    Raises:
        Rejected: another shape, not finite, or outside the joints' position limits.
    """
    values = np.array(action, dtype=np.float64)
    if values.shape != (embodiment.dim,):
        raise Rejected(
            f"{embodiment.name} takes actions of shape ({embodiment.dim},), got {values.shape}"
        )
    for joint, value in zip(embodiment.joints, values, strict=True):
        if not np.isfinite(value):
            raise Rejected(f"{joint.name}: the command is {value}, not a finite number")
        if not joint.lower <= value <= joint.upper:
            raise Rejected(
                f"{joint.name}: the command {value:.4g} {joint.unit} is outside "
                f"[{joint.lower:.4g}, {joint.upper:.4g}]"
            )
    return values


def hold_target(embodiment: EmbodimentSpec, last: Array, state: Array, age_s: float) -> Array:
    """The command that holds an arm: the last one, but for joints that were kept from following.

    Grippers keep their last command always: what they hold is why they are behind it. A joint may
    have gone on since it was measured, at its limit at most; where it can be at its last command by
    now it is not sent back to where it was.

    Args:
        last: ``(dim,)`` last command.
        state: ``(state_dim,)`` as measured.
        age_s: how long ago that was, in seconds.
    """
    where = dict(zip(embodiment.state_names, state, strict=True))
    target = last.copy()
    for index, joint in enumerate(embodiment.joints):
        measured = where.get(joint.name)
        if joint.kind == "gripper" or measured is None:
            continue
        if abs(measured - last[index]) > HOLD_REACH + joint.velocity * age_s:
            target[index] = min(max(measured, joint.lower), joint.upper)
    return target
