"""A Gymnasium observation taken apart: arrays by name, images and texts among them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import SpecMismatch

Parts = Mapping[str, npt.NDArray[Any]]


def parts(observation: Any, prefix: str = "") -> dict[str, npt.NDArray[Any]]:
    """Arrays by name, sorted; the names of nested ones are joined by dots. Texts are arrays, too.

    An observation that is one array has the name ``""``, or ``image`` if it is an image.

    Raises:
        SpecMismatch: a part is neither an array of numbers nor text.
    """
    if isinstance(observation, (tuple, list)) and not all(
        np.isscalar(each) for each in observation
    ):
        observation = {str(number): each for number, each in enumerate(observation)}
    if isinstance(observation, Mapping):
        arrays: dict[str, npt.NDArray[Any]] = {}
        for key in sorted(observation):
            arrays |= parts(observation[key], f"{prefix}.{key}" if prefix else str(key))
        return arrays
    array = np.asarray(observation)
    if array.dtype.kind not in "biufU":
        raise SpecMismatch(
            f"the observation's part {prefix or 'as a whole'!r} is a {type(observation).__name__}: "
            "no array of numbers, and no text",
            next="make the environment with a wrapper that gives arrays",
        )
    return {prefix or ("image" if is_image(array) else ""): array}


def is_text(array: npt.NDArray[Any]) -> bool:
    """Whether it is words."""
    return array.dtype.kind == "U"


def text(found: Parts, key: str) -> str:
    """The text called ``key``.

    Raises:
        SpecMismatch: there is no such text.
    """
    if key not in found or not is_text(found[key]):
        texts = ", ".join(name for name, array in found.items() if is_text(array))
        raise SpecMismatch(
            f"instruction_from: the observation has no text {key!r}; it has {texts or 'none'}"
        )
    return str(found[key])


def is_image(array: npt.NDArray[Any]) -> bool:
    """Whether it is ``(H, W, 3)`` uint8."""
    return array.dtype == np.uint8 and array.ndim == 3 and array.shape[2] == 3


def images_of(found: Parts) -> dict[str, npt.NDArray[np.uint8]]:
    """The parts that are images."""
    return {name: array for name, array in found.items() if is_image(array)}


def state_row(found: Parts, keys: Sequence[str] | None) -> npt.NDArray[np.float64]:
    """The parts ``keys``, or all that are neither images nor texts, as one row.

    Raises:
        SpecMismatch: there is no such part, or it is a text.
    """
    if keys is None:
        keys = [n for n, array in found.items() if not is_image(array) and not is_text(array)]
    missing = [key for key in keys if key not in found]
    if missing:
        raise SpecMismatch(
            f"state: the observation has no part {missing[0]!r}; it has {', '.join(found)}"
        )
    words = [key for key in keys if is_text(found[key])]
    if words:
        raise SpecMismatch(
            f"state: the observation's part {words[0]!r} is a text",
            next=f"leave it out; as an instruction it is given by instruction_from = {words[0]!r}",
        )
    rows = [np.asarray(found[key], dtype=np.float64).ravel() for key in keys]
    return np.concatenate(rows) if rows else np.zeros(0)
