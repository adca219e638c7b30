"""Checks of what an operator returns: frames, states, actions and numbers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.frame import Frame
from fluxvla_core.control.safety import BadFrame
from fluxvla_core.spec import EmbodimentSpec


def as_frame(value: Any, source: str) -> Frame:
    """``value``, checked to have the fields of a ``Frame``.

    Args:
        value: what ``source`` gave, for example ``Arm.get_frame()``.

    Raises:
        BadFrame: it is something else; names ``source``.
    """
    fields = ("state", "images", "stamps")
    if not all(hasattr(value, field) for field in fields):
        raise BadFrame(
            f"{source} gave a {type(value).__name__}, not a Frame",
            cause="a Frame has state, images and stamps; where there is no reading yet, "
            "get_frame() raises NotReady",
            next="see docs/writing-a-plugin.md for an example",
        )
    for field in fields[1:]:
        found = getattr(value, field)
        if not isinstance(found, Mapping):
            raise BadFrame(f"{field} of what {source} gave is a {type(found).__name__}, not a dict")
    frame: Frame = value
    return frame


def as_state(value: Any, embodiment: EmbodimentSpec, source: str) -> npt.NDArray[np.float64]:
    """``value`` as a checked ``(state_dim,)`` float64 array; ``source`` is for the message.

    Raises:
        BadFrame: it is no array of numbers, has another shape, or is not finite.
    """
    return _as_vector(value, embodiment.state_names, embodiment.name, source)


def as_action(value: Any, embodiment: EmbodimentSpec, source: str) -> npt.NDArray[np.float64]:
    """``value`` as a checked ``(dim,)`` float64 array; ``source`` is for the message.

    Raises:
        BadFrame: it is no array of numbers, has another shape, or is not finite.
    """
    return _as_vector(value, embodiment.joint_names, embodiment.name, source)


def as_number(value: Any, source: str) -> float:
    """``value`` as a float, checked to be finite; ``source`` is for the message.

    Raises:
        BadFrame: it is none.
    """
    if not is_number(value) or not math.isfinite(value):
        raise BadFrame(f"{source} is {value!r}, not a finite number")
    return float(value)


def is_number(value: Any) -> bool:
    """Whether ``value`` is a real number, of Python or numpy, and not a bool."""
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)


def check_frame(frame: Frame, embodiment: EmbodimentSpec, cameras: Iterable[str]) -> None:
    """Refuse a frame that is not what the embodiment describes.

    Args:
        frame: as ``Operator.get_frame`` returns it.
        embodiment: whose state and cameras are expected.
        cameras: names of the cameras that are needed.

    Raises:
        BadFrame: state of another shape or not finite; a camera missing; an image that is not
            ``(height, width, 3)`` uint8 of the camera's size.
    """
    as_state(frame.state, embodiment, "the robot's state")
    sizes = {camera.name: (camera.height, camera.width, 3) for camera in embodiment.cameras}
    for name in cameras:
        image = frame.images.get(name)
        if image is None:
            raise BadFrame(
                f"camera {name} gave no image", cause="it is not connected, or has another name"
            )
        if not isinstance(image, np.ndarray):
            raise BadFrame(f"camera {name} gives a {type(image).__name__}, not an array")
        if image.dtype != np.uint8 or image.shape != sizes.get(name, image.shape):
            raise BadFrame(
                f"camera {name} gives {image.shape} {image.dtype}, "
                f"the embodiment says {sizes.get(name)} uint8",
                cause="the camera's mode was changed, or the spec is of another camera",
            )


def _as_vector(
    value: Any, names: tuple[str, ...], robot: str, source: str
) -> npt.NDArray[np.float64]:
    try:
        vector = np.asarray(value)
    except ValueError:  # rows of different lengths
        vector = np.empty(0, dtype=object)
    if vector.dtype.kind not in "fiu":
        raise BadFrame(f"{source} is no array of numbers, but a {type(value).__name__}")
    if vector.shape != (len(names),):
        raise BadFrame(f"{source} has shape {vector.shape}; {robot} has ({len(names)},)")
    bad = [name for name, ok in zip(names, np.isfinite(vector), strict=True) if not ok]
    if bad:
        raise BadFrame(f"{source} is not finite for {', '.join(bad)}")
    return vector.astype(np.float64)
