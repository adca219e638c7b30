"""A policy's actions back to what its model computes with, whatever made them physical.

A checkpoint, or a config, says how a model's actions become a robot's (``denormalize_action``).
What undoes that is not said, and may depend on the state (actions relative to it). But whatever can
be undone scales and shifts, element by element, so that two of its answers tell it all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
# float32 statistics and the sizes that joints have: far above rounding, far below a mistake.
_CLOSE = 1e-4


@dataclass(frozen=True)
class Scaling:
    """``physical = offset + slope * normalized``, both ``(T, D)``; the model's rows are wider."""

    offset: Array
    slope: Array
    width: int

    def normalized(self, actions: Array) -> Array:
        """``(T, D)`` physical -> ``(T, width)``; 0 where nothing depends on the model's value."""
        fixed = self.slope == 0.0
        values = np.where(fixed, 0.0, (actions - self.offset) / np.where(fixed, 1.0, self.slope))
        return np.pad(values, ((0, 0), (0, self.width - values.shape[1])))


def scaling_of(
    denormalize: Callable[[Mapping[str, Any]], Array], shape: tuple[int, int], states: Array
) -> Scaling | None:
    """What ``denormalize`` does to a chunk of ``shape`` ``(T, width)`` in ``states`` ``(S,)``.

    None if it does not scale and shift element by element: it rounds, clips or mixes.
    """
    rng = np.random.default_rng(0)
    probe = rng.uniform(-1.0, 1.0, shape)
    zeros, ones, found = (
        denormalize({"action": rows[None].astype(np.float32), "states": states})
        for rows in (np.zeros(shape), np.ones(shape), probe)
    )
    scaling = Scaling(zeros, ones - zeros, shape[1])
    expected = zeros + scaling.slope * probe[:, : zeros.shape[1]]
    size = np.abs(zeros).max() + np.abs(ones).max() + 1e-12
    return scaling if np.allclose(found, expected, rtol=0.0, atol=_CLOSE * size) else None
