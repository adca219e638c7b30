"""ROS message types: their names, their classes, their time stamps.

Message packages are imported when a class is asked for, never before.
"""

from __future__ import annotations

import functools
import importlib
import re
from typing import Any, ClassVar

from fluxvla_core.errors import ConfigError, Faulted, LoadFailed

JOINT_STATE = "sensor_msgs.msg:JointState"
IMAGE = "sensor_msgs.msg:Image"
COMPRESSED_IMAGE = "sensor_msgs.msg:CompressedImage"
TWIST = "geometry_msgs.msg:Twist"
ODOMETRY = "nav_msgs.msg:Odometry"
FLOAT64 = "std_msgs.msg:Float64"
FLOAT64_ARRAY = "std_msgs.msg:Float64MultiArray"
_TYPE = re.compile(r"(?P<package>\w+)[./](?P<kind>msg|srv|action)[:/](?P<name>\w+)")


class BadMessage(Faulted):
    """A message is not what the embodiment describes: names, sizes, encodings, numbers.

    The arm still obeys: it is braked and held, by the safety rule named here.
    """

    rule: ClassVar[str] = "frame"


@functools.cache
def message_class(path: str) -> Any:
    """The class that ``sensor_msgs.msg:Image`` (or ``sensor_msgs/msg/Image``) names.

    Raises:
        ConfigError: ``path`` is not of that form.
        LoadFailed: the package is not there, or has no such message.
    """
    found = _TYPE.fullmatch(path)
    if found is None:
        raise ConfigError(
            f"{path!r} names no ROS message type; write it as 'sensor_msgs.msg:JointState'"
        )
    package, kind, name = found["package"], found["kind"], found["name"]
    try:
        module = importlib.import_module(f"{package}.{kind}")
    except ImportError as error:
        raise LoadFailed(
            f"the ROS message type {path} cannot be imported ({error})",
            cause=f"the package {package} is not installed, or its workspace is not sourced",
            next=f"apt install ros-$ROS_DISTRO-{package.replace('_', '-')}, or source the "
            f"workspace that has {package}, in this shell",
        ) from error
    if not hasattr(module, name):
        has = ", ".join(n for n in sorted(vars(module)) if n[:1].isupper() and "_" not in n)
        raise LoadFailed(f"{package}.{kind} has no {name}; it has {has or 'no messages'}")
    return getattr(module, name)


def type_name(cls: Any) -> str:
    """``sensor_msgs/msg/Image`` for the class, as the graph names types."""
    package, kind = cls.__module__.split(".")[:2]
    return f"{package}/{kind}/{cls.__name__}"


def stamp_of(message: Any) -> float | None:
    """Seconds of ``header.stamp``; None without a header, or where the sender left it at zero."""
    header = getattr(message, "header", None)
    if header is None:
        return None
    seconds = float(header.stamp.sec) + header.stamp.nanosec * 1e-9
    return seconds or None
