"""``sensor_msgs/JointState`` by joint name, never by position in the message.

Drivers order joints differently, and change the order between versions; a joint's name is all that
identifies it.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.ros2.messages import BadMessage

Array = npt.NDArray[np.float64]


def positions(message: Any, names: Sequence[str], source: str = "joint states") -> Array:
    """``(len(names),)`` positions of the joints called ``names``, in that order.

    Joints that nobody asked for (fingers, other arms) are passed over.

    Raises:
        BadMessage: a joint is missing, named twice, without position, or not finite; or the message
            has no names at all. Names ``source`` and what the message does have.
    """
    columns = _columns(tuple(message.name), len(message.position), tuple(names), source)
    values = np.asarray(message.position, np.float64)[columns]
    if not np.isfinite(values).all():
        bad = [name for name, value in zip(names, values, strict=True) if not np.isfinite(value)]
        raise BadMessage(f"{source}: the position of {', '.join(bad)} is not a finite number")
    return values


# A driver sends the same names with every message; a few streams with a few orders each.
@functools.lru_cache(maxsize=64)
def _columns(sent: tuple[str, ...], count: int, names: tuple[str, ...], source: str) -> list[int]:
    """Index of each joint in a message that has the names ``sent`` and ``count`` positions."""
    if not sent:
        raise BadMessage(
            f"{source}: {count} positions without joint names; joints are identified by name alone",
            next="let the driver fill JointState.name",
        )
    if count != len(sent):
        raise BadMessage(f"{source}: {len(sent)} joint names, but {count} positions")
    at = {name: index for index, name in enumerate(sent)}
    if len(at) != len(sent):
        twice = sorted({name for name in sent if sent.count(name) > 1})
        raise BadMessage(f"{source}: joint names come twice: {', '.join(twice)}")
    missing = [name for name in names if name not in at]
    if missing:
        raise BadMessage(
            f"{source}: no joint called {', '.join(missing)}; there are {', '.join(sent)}",
            cause="another robot, or a driver that names its joints in another way",
            next="give the operator the names that its driver uses (joint_names)",
        )
    return [at[name] for name in names]


def fill(message: Any, names: Sequence[str], values: npt.ArrayLike) -> Any:
    """Put names and positions into a ``JointState`` (or what has these fields); returns it.

    Lists of float are what the generated setters take without converting one by one.
    """
    message.name = list(names)
    message.position = np.asarray(values, np.float64).tolist()
    return message
