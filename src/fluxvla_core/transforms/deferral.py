"""Normalising pictures where the model computes: they travel as uint8, with what is left to do.

What is left to do stands in the sample as ``image_scale``, ``(4, 3N)`` float32: for each plane
what to divide by, multiply by, subtract and divide by, in this order. Doing nothing is exact (by
1, or 0), so one formula serves every normaliser, bit for bit, and each sample of a batch has its
own numbers.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

SCALE = "image_scale"

Row = npt.NDArray[np.float32] | None
Steps = tuple[Row, Row, Row, Row]
"""Divide by, multiply by, subtract, divide by: each ``(3N,)``, or None for nothing."""

_Operation = Callable[[Any, Any], Any]
_OPERATIONS: tuple[_Operation, ...] = (
    operator.itruediv,
    operator.imul,
    operator.isub,
    operator.itruediv,
)
_NOTHING = (1, 1, 0, 1)


def scale_(images: Any, rows: Sequence[Any]) -> Any:
    """``images`` ``(..., 3N, H, W)`` float32, numpy's or torch's, changed in place by ``rows``."""
    for operation, row in zip(_OPERATIONS, rows, strict=True):
        if row is not None:
            images = operation(images, row[..., None, None])
    return images


def as_array(steps: Steps, planes: int) -> npt.NDArray[np.float32]:
    """``(4, planes)``: ``steps`` as they travel."""
    rows = [
        np.full(planes, nothing, np.float32) if row is None else row
        for row, nothing in zip(steps, _NOTHING, strict=True)
    ]
    return np.stack(rows)


def normalized(batch: Mapping[str, Any]) -> dict[str, Any]:
    """A batch of tensors without ``image_scale``, its pictures float32 as that says."""
    rest = dict(batch)
    scale = rest.pop(SCALE, None)
    if scale is not None:
        images = rest["images"].to(scale.dtype, copy=True)
        rest["images"] = scale_(images, scale.unbind(1))
    return rest


def deferring(dataset: Any) -> Any:
    """What ``dataset.deferring()`` gives; None if another class than that one's makes samples."""
    defer = declared(dataset, "deferring", "get_samples")
    return None if defer is None else defer(dataset)


def declared(thing: object, name: str, method: str) -> Any:
    """What the class that ``thing`` has its ``method`` from says under ``name``, else None.

    A subclass with a ``method`` of its own does not inherit what was said of another one, and a
    wrapper that hands attributes through says nothing.
    """
    owner = next((cls for cls in type(thing).__mro__ if method in vars(cls)), object)
    return vars(owner).get(name)
