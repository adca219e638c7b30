"""What a policy is told about the motion under way, when its next chunk has to go on from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt


@dataclass(frozen=True)
class Continuation:
    """The rest of the chunk that is being played, at the times of the chunk that is asked for.

    Args:
        actions: ``(T, dim)`` float64 in physical units, ``T`` being the policy's horizon: where
            the arm is going to be at the times of the new chunk's keyframes if no new chunk comes.
            Rows beyond the end of what is known repeat its last.
        weights: ``(T,)`` float64, how much the new chunk has to agree with each row: 1 for rows
            that will have been executed before the answer arrives, 0 for those that are free.
        frozen: how many rows at the beginning will have been executed, by measured latency.
        max_guidance_weight: bound of the pull towards ``actions``, for policies that are guided.
    """

    actions: npt.NDArray[np.float64]
    weights: npt.NDArray[np.float64]
    frozen: int
    max_guidance_weight: float = 5.0
