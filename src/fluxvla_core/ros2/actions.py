"""Actions as they may be sent: checked before any I/O, and the one that holds an arm."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import Rejected
from fluxvla_core.safety.trips import HOLD_REACH
from fluxvla_core.spec.embodiment import EmbodimentSpec

Array = npt.NDArray[np.float64]


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


def hold_target(embodiment: EmbodimentSpec, last: Array, state: Array, moved: Array) -> Array:
    """The command that holds an arm: the last one, but for joints that were kept from following.

    Such a joint (``HOLD_REACH``) is held where it is: pushing on would be no stop. Grippers have no
    such reach and keep their command: what they hold is why they are behind it. A joint may
    have gone on since it was measured; where it can be at its last command by now it is not sent
    back to where it was. One that did not move then is not taken to have moved since.

    Args:
        last: ``(dim,)`` last command.
        state: ``(state_dim,)`` as measured.
        moved: ``(state_dim,)`` how far each joint has gone since, if it went on as it did.
    """
    where = {name: index for index, name in enumerate(embodiment.state_names)}
    target = last.copy()
    for index, joint in enumerate(embodiment.joints):
        column = where.get(joint.name)
        if column is None:
            continue
        if abs(state[column] - last[index]) > HOLD_REACH[joint.kind] + moved[column]:
            target[index] = min(max(state[column], joint.lower), joint.upper)
    return target
