"""Random weights and inputs that two implementations can make alike, from names alone.

Each array follows from its name, so that neither weights nor inputs have to be stored: a program
that runs in the environment of another implementation and a test here call the same functions.
It needs numpy alone.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt


def normal(name: str, shape: Sequence[int], scale: float = 1.0) -> npt.NDArray[np.float32]:
    """Standard normal numbers times ``scale``, float32."""
    return (_generator(name).standard_normal(tuple(shape)) * scale).astype(np.float32)


def uniform(
    name: str, shape: Sequence[int], low: float = 0.0, high: float = 1.0
) -> npt.NDArray[np.float32]:
    """Uniform numbers in ``low``..``high``, float32."""
    return _generator(name).uniform(low, high, tuple(shape)).astype(np.float32)


def integers(name: str, shape: Sequence[int], high: int) -> npt.NDArray[np.int64]:
    """Whole numbers in 0..``high`` - 1, int64."""
    return _generator(name).integers(0, high, tuple(shape))


def weight(name: str, shape: Sequence[int]) -> npt.NDArray[np.float32]:
    """A tensor of a model under its published name: of a size at which signals neither die nor
    explode, and no tensor is 0 or 1 as a whole, so that none can be left out unseen."""
    if len(shape) < 2:
        return normal(name, shape, 0.1)
    return normal(name, shape, 1.0 / float(np.sqrt(np.prod(shape[1:]))))


def _generator(name: str) -> np.random.Generator:
    digest = hashlib.sha256(name.encode()).digest()
    key = np.frombuffer(digest[:16], np.uint64)
    return np.random.Generator(np.random.Philox(key=key))
