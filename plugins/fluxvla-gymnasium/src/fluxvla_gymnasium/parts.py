"""A Gymnasium observation taken apart: arrays by name, pictures among them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import SpecMismatch

Parts = Mapping[str, npt.NDArray[Any]]


def parts(seen: Any, prefix: str = "") -> dict[str, npt.NDArray[Any]]:
    """Arrays by name, sorted; the names of nested ones are joined by dots.

    An observation that is one array has the name ``""``, or ``image`` if it is a picture.
    """
    if isinstance(seen, Mapping):
        found: dict[str, npt.NDArray[Any]] = {}
        for key in sorted(seen):
            found |= parts(seen[key], f"{prefix}.{key}" if prefix else str(key))
        return found
    array = np.asarray(seen)
    return {prefix or ("image" if is_picture(array) else ""): array}


def is_picture(array: npt.NDArray[Any]) -> bool:
    """Whether it is ``(H, W, 3)`` uint8."""
    return array.dtype == np.uint8 and array.ndim == 3 and array.shape[2] == 3


def pictures(found: Parts) -> dict[str, npt.NDArray[np.uint8]]:
    """Those parts that are pictures."""
    return {name: array for name, array in found.items() if is_picture(array)}


def state_row(found: Parts, keys: Sequence[str] | None) -> npt.NDArray[np.float64]:
    """The parts ``keys``, or all that are no pictures, as one row.

    Raises:
        SpecMismatch: there is no such part.
    """
    if keys is None:
        keys = [name for name, array in found.items() if not is_picture(array)]
    missing = [key for key in keys if key not in found]
    if missing:
        raise SpecMismatch(
            f"state: the observation has no part {missing[0]!r}; it has {', '.join(found)}"
        )
    rows = [np.asarray(found[key], dtype=np.float64).ravel() for key in keys]
    return np.concatenate(rows) if rows else np.zeros(0)
