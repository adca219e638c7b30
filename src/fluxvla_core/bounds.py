"""Types of bounded numbers, for files that are read with ``untrusted``.

A module of its own because importing ``annotated_types`` takes 10 ms at a command's start.
"""

from __future__ import annotations

import math
from typing import Annotated

from annotated_types import Ge, Gt, Lt

Finite = Annotated[float, Gt(-math.inf), Lt(math.inf)]
"""Neither NaN nor infinite."""
Positive = Annotated[float, Gt(0), Lt(math.inf)]
"""A finite number above 0."""
Count = Annotated[int, Ge(0), Lt(1 << 53)]
"""A whole number that a float holds exactly; sums and products of a few fit 64 bits."""
