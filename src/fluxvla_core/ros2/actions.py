"""Actions as they may be sent: checked before any I/O."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import Rejected
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
