"""Offsets that disturb the cube scene's expert without asking for what no arm can do."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fluxvla_sim.aloha.arms import DIM
from fluxvla_sim.aloha.tasks import MAX_STEPS
from fluxvla_sim.motion import slow_noise

if TYPE_CHECKING:
    import numpy.typing as npt

# Steps in which a few millimetres decide: coming down on the cube, changing hands.
_DELICATE = ((55, 112), (130, 215))


def smooth_noise(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """``(300, 14)`` offsets of about unit size: slow, smaller where it is delicate, no grippers."""
    return slow_noise(rng, MAX_STEPS, DIM, _DELICATE, grippers=(6, 13))
