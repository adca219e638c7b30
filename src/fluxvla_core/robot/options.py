"""Checks of an inference runner's settings against its robot, and building its action filters."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from fluxvla_core.build import RunContext, build_action_filter_from_cfg
from fluxvla_core.contracts.robot import ActionFilter
from fluxvla_core.errors import ConfigError
from fluxvla_core.robot.control.filters import SnapGripper
from fluxvla_core.robot.control.joiners import make_joiner
from fluxvla_core.robot.robot import Robot
from fluxvla_core.spec.embodiment import EmbodimentSpec

WrongKey = Callable[[str, str], ConfigError]
"""Makes the error about a key of the section: the key, and what is wrong with its value."""


def checked_joining(value: Any, async_execution: bool, wrong: WrongKey) -> Any:
    """The config's ``chunk_joining``, or its default.

    Raises:
        ConfigError: there is no such method, or it contradicts ``async_execution``.
    """
    if value is None:
        return "latest_only" if async_execution else "synchronous"
    try:
        joiner = make_joiner(value)
    except ConfigError as error:
        raise wrong("chunk_joining", error.what) from error
    if async_execution and not joiner.streamed:
        raise wrong("chunk_joining", f"is {value!r}, and async_execution is set")
    return value


def checked_rate(publish_rate: float | None, robot: Robot, wrong: WrongKey) -> float:
    """Commands a second: the config's ``publish_rate``, or the embodiment's rate.

    Raises:
        ConfigError: the robot does not take commands at this rate.
    """
    most = robot.embodiment.rate_hz
    if publish_rate is None:
        return most
    if not 0 < publish_rate <= most:
        raise wrong(
            "publish_rate",
            f"is {publish_rate:g} Hz; {robot.embodiment.name} takes up to "
            f"{most:g} commands a second",
        )
    if robot.lockstep and publish_rate != most:
        raise wrong(
            "publish_rate",
            f"is {publish_rate:g} Hz, but each command to this simulation lasts 1/{most:g} s",
        )
    return float(publish_rate)


def check_state_dim(state_dim: int | None, embodiment: EmbodimentSpec, wrong: WrongKey) -> None:
    """Refuse a ``state_dim`` that is not the robot's.

    Raises:
        ConfigError: it is another one.
    """
    if state_dim is not None and state_dim != embodiment.state_dim:
        raise wrong(
            "state_dim",
            f"is {state_dim}; {embodiment.name} has {embodiment.state_dim} state values",
        )


def check_latency(seconds: float, robot: Robot, wrong: WrongKey) -> None:
    """Refuse a ``simulated_latency`` that no run can have.

    Raises:
        ConfigError: it is negative or not finite, or the robot's time does not stand still.
    """
    if not 0.0 <= seconds < math.inf:
        raise wrong("simulated_latency", f"must be 0 or more, got {seconds}")
    if seconds and not robot.lockstep:
        raise wrong("simulated_latency", "is for simulations; this robot has its own")


def build_filters(
    tables: Sequence[Any],
    gripper_threshold: float | None,
    embodiment: EmbodimentSpec,
    context: RunContext | None,
) -> list[ActionFilter]:
    """The action filters of a run, in order, bound to the robot.

    Args:
        tables: the config's ``action_filters``: tables or callables.
        gripper_threshold: of a ``SnapGripper`` after them, right before the limits; None for none.
        embodiment: of the robot.
        context: of the run.

    Raises:
        ConfigError, PluginError: one of them cannot be built, or does not fit the robot.
    """
    built = [build_action_filter_from_cfg(each, context) for each in tables]
    filters = [ActionFilter.adapt(each) for each in built]
    if gripper_threshold is not None:
        filters.append(SnapGripper(gripper_threshold))
    for each in filters:
        each.bind(embodiment)
    return filters
