"""Dividing a robot between two processes: one commands it, the other reads its cameras."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fluxvla_core.contracts.contract import implements
from fluxvla_core.contracts.robot import Operator
from fluxvla_core.plugins.registry import ACTION_FILTERS, OPERATORS
from fluxvla_core.robot.control.clock import clock_of, in_lockstep
from fluxvla_core.robot.process.setup import import_path, not_plain


@dataclass(frozen=True)
class Tables:
    """What another process builds the robot's commanding side from.

    Args:
        operator: the operator's table; an object cannot be built there.
        filters: those of the action filters.
        gripper_threshold: as the runner has it.
    """

    operator: Any
    filters: Sequence[Any]
    gripper_threshold: float | None


@dataclass(frozen=True)
class Division:
    """Whether another process commands the robot.

    Args:
        operator: what this process has of the robot.
        tables: what the other process builds its part from; None where there is no other.
        obstacle: why there is none; None where there is.
    """

    operator: Any
    tables: Tables | None = None
    obstacle: str | None = None


def divide(
    operator: Any, tables: Tables, config: Mapping[str, Any], obstacle: str | None
) -> Division:
    """Divide a robot between two processes where that is possible.

    Args:
        operator: the operator, not connected; the division's takes its place.
        tables: what it was built from, or objects.
        config: the whole config.
        obstacle: why it is not to be divided; None where that depends on the rest.
    """
    obstacle = obstacle or _obstacle(operator, tables, config)
    if obstacle is not None:
        return Division(operator, obstacle=obstacle)
    part = Operator.adapt(operator).without_commands()
    if part is None:
        name = type(operator).__name__
        return Division(operator, obstacle=f"{name}, as it is set, cannot be divided")
    return Division(part, tables)


def _obstacle(operator: Any, tables: Tables, config: Mapping[str, Any]) -> str | None:
    made = Operator.adapt(operator)
    if sys.platform != "linux":
        return "this system has no memory that two processes share by a descriptor"
    if in_lockstep(clock_of(made)):
        return "the time of this simulation stands still between commands"
    if not implements(made, Operator, "without_cameras"):
        return f"{type(made).__name__} cannot be divided (Operator.without_cameras)"
    for registry, built in ((OPERATORS, [tables.operator]), (ACTION_FILTERS, tables.filters)):
        for each in built:
            if not isinstance(each, Mapping):
                return f"{type(each).__name__} is an object, not a table"
            cls = registry.registered(each["type"])
            if cls is not None and import_path(cls) is None:
                return f"{each['type']} is defined where no other process can import it"
    values = {
        "operator": tables.operator,
        "action_filters": tables.filters,
        "config": config,
    }
    return next(filter(None, (not_plain(value, key) for key, value in values.items())), None)
