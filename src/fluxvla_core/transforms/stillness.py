"""Dimensions that hardly move in the data, and that a normalisation divides by next to nothing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

ORDINARY = 200.0
"""More than any ordinary range in units of what it is divided by: ``min_max`` makes it 2, a
``quantile`` or deviation of what moves now and then some 20."""
TINY = 1e-4
"""Of a state divided by less, an error of 0.01 in a reading is more than 100."""


@dataclass(frozen=True)
class Still:
    """A dimension; ``spread`` is from its min to its max, ``scale`` what it is divided by.

    ``blown_up``: what little it moves in the data becomes huge, not only what a robot reads.
    ``rare``: it moves in under 2 % of the frames, so that its q01 and q99 are equal.
    """

    name: str
    spread: float
    scale: float
    blown_up: bool
    rare: bool

    def __str__(self) -> str:
        return f"{self.name} (range {self.spread:.2g}, divided by {self.scale:.2g})"


def hardly_moving(
    what: str,
    stats: Mapping[str, Any],
    scale: Floats,
    names: Sequence[str],
    mask: Sequence[bool] | None = None,
) -> Iterator[Still]:
    """Those of one statistics entry; of several steps each dimension's worst one counts.

    Args:
        what: said before the names.
        scale: what is divided by, as wide as the statistics.
        names: of the dimensions; they are counted where there are none.
        mask: ``(D,)``; False where nothing is divided.
    """
    if not {"min", "max", "q01", "q99"} <= set(stats):
        return
    low, high, q01, q99 = (np.atleast_2d(stats[k]) for k in ("min", "max", "q01", "q99"))
    spread, scale = high - low, np.atleast_2d(scale)
    rare = (q01 == q99) & (spread > 0)
    for d in range(spread.shape[1]):
        reach = spread[:, d] / scale[:, d]
        blown_up = bool(reach.max() > ORDINARY)
        step = int(reach.argmax() if blown_up else scale[:, d].argmin())
        used = mask is None or mask[d]
        if used and (blown_up or scale[step, d] < TINY):
            name = f"{what} {names[d] if names else d}"
            yield Still(name, spread[step, d], scale[step, d], blown_up, bool(rare[step, d]))
