"""Importing ROS 2 where it is needed, with one clear message where it is not there."""

from __future__ import annotations

import ctypes
import functools
import importlib
import os
import re
import sys
from collections.abc import Mapping
from types import ModuleType
from typing import Any

from fluxvla_core.errors import ConfigError, LoadFailed

# Python that each distribution's packages are built for (REP 2000).
_PYTHONS: Mapping[str, str] = {
    "humble": "3.10",
    "iron": "3.10",
    "jazzy": "3.12",
    "kilted": "3.12",
}
_TYPE = re.compile(r"(?P<package>\w+)[./](?P<kind>msg|srv|action)[:/](?P<name>\w+)")


def require_rclpy(environ: Mapping[str, str] = os.environ) -> ModuleType:
    """The module ``rclpy``.

    Raises:
        LoadFailed: it cannot be imported, or the middleware that the environment asks for cannot
            be loaded (``rclpy.init`` would end the process then); says how to get them.
    """
    try:
        rclpy = importlib.import_module("rclpy")
    except ImportError as error:
        raise LoadFailed(
            f"ROS 2 cannot be used: importing rclpy fails ({error})",
            cause=_cause(error, environ),
            next="on a robot, source /opt/ros/<distribution>/setup.bash and use the Python that "
            "ROS was built for; for development (Linux, x86-64), "
            "pip install 'fluxvla-core[ros2]'",
        ) from error
    _require_middleware(environ)
    return rclpy


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


def _cause(error: ImportError, environ: Mapping[str, str]) -> str:
    if "cannot open shared object" in str(error):
        return "a library of ROS 2 is missing (with wheels: ros-kilted-rmw-fastrtps-cpp)"
    distribution = environ.get("ROS_DISTRO", "")
    built_for = _PYTHONS.get(distribution)
    here = f"{sys.version_info[0]}.{sys.version_info[1]}"
    if built_for and built_for != here:
        return f"ROS 2 {distribution} is built for Python {built_for}, this is Python {here}"
    if distribution:
        return f"ROS 2 {distribution} is sourced, but this Python does not see its packages"
    return "no ROS 2 is installed for this Python, or its setup file was not sourced"


def _require_middleware(environ: Mapping[str, str]) -> None:
    name = environ.get("RMW_IMPLEMENTATION")
    if not name:
        return
    try:
        ctypes.CDLL(f"lib{name}.so")
    except OSError as error:
        raise LoadFailed(
            f"RMW_IMPLEMENTATION is {name!r}, and that middleware cannot be loaded ({error})",
            next="unset RMW_IMPLEMENTATION, or install the middleware that it names",
        ) from error
