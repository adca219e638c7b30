"""Which process commands a robot: ``choose_layout``.

A control process is used wherever that is possible. An operator may be divided between the two: the
control process commands the robot, the main process reads its cameras. One that cannot be divided
runs as a whole in the control process, which sends its images to the main process.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from fluxvla_core.build import RunContext, parameters
from fluxvla_core.contracts.contract import implements
from fluxvla_core.contracts.robot import Operator
from fluxvla_core.control.clock import MonotonicClock, clock_of, in_lockstep
from fluxvla_core.plugins.registry import ACTION_FILTERS, OPERATORS, RUNNERS
from fluxvla_core.robot.process.remote_operator import RemoteOperator
from fluxvla_core.robot.process.setup import import_path, not_plain
from fluxvla_core.robot.robot import Robot
from fluxvla_core.spec import EmbodimentSpec

Embodiment: TypeAlias = "EmbodimentSpec | Mapping[str, Any] | None"


@dataclass(frozen=True)
class ControlTables:
    """The tables that the control process builds the operator and the filters from.

    Args:
        operator: the operator's table; an object cannot be built there.
        filters: those of the action filters.
        gripper_threshold: as the runner has it.
    """

    operator: Any
    filters: Sequence[Any]
    gripper_threshold: float | None


@dataclass(frozen=True)
class ProcessLayout:
    """Which parts of a robot this process and, if there is one, its control process have.

    Args:
        operator: this process's operator, or the part of it that this process has.
        robot: made of it; not connected.
        tables: what the control process is built from; None where there is none.
        why_single_process: why there is no control process; None where there is one.
        remote_operator: ``operator``, where the control process has all of the robot.
        runner: the table of the runner, where the control process needs its methods too.
    """

    operator: Any
    robot: Robot
    tables: ControlTables | None = None
    why_single_process: str | None = None
    remote_operator: RemoteOperator | None = None
    runner: Mapping[str, Any] | None = None

    @property
    def notice(self) -> str | None:
        """A message to the user about it; None for nothing."""
        if self.remote_operator is not None:
            return f"{self.robot.name} is not divided: the control process reads its images too"
        if self.why_single_process is None or self.robot.lockstep:
            return None
        return f"no control process: {self.why_single_process}"


_SENDING = ("_execute_actions",)
_OBSERVING = ("get_ros_observation", "update_observation_window")
# What the control process has no use for, or builds itself.
_BUILT_APART = ("policy", "action_filters")
# Of every class.
_USUAL = ("_abc_impl", "api", "Options")


@dataclass(frozen=True)
class RunnerOverrides:
    """Which methods a runner's class overrides, and whether a control process can have them.

    Args:
        runner: the name of its class.
        sends, observes: whether it has an ``_execute_actions``, or a ``get_ros_observation`` or
            ``update_observation_window``.
        table: what it is built from, without its policy and filters; None where nobody knows.
        obstacle: why another process cannot have these methods; None where it can.
    """

    runner: str
    sends: bool
    observes: bool
    table: Mapping[str, Any] | None
    obstacle: str | None

    @classmethod
    def of(cls, runner: type, base: type, context: RunContext) -> RunnerOverrides:
        """The overrides of a class derived from ``base``, which is ``BaseInferenceRunner``."""
        derived = runner.__mro__[: runner.__mro__.index(base)]
        defined = {name for each in derived for name in vars(each)}
        known = {*_SENDING, *_OBSERVING, *_USUAL}
        changed = sorted(defined & set(vars(base)) - known)
        more = [name for name in changed if not name.startswith("__")]
        said = context.config.get(context.section)
        table, name = None, runner.__name__
        if isinstance(said, Mapping) and said.get("type") in RUNNERS:
            found = RUNNERS.get(said["type"])
            left = {key: value for key, value in said.items() if key not in _BUILT_APART}
            table = {**left, "control_process": False} if found is runner else None
        obstacle = None
        if table is None:
            obstacle = f"{name} was not built from the config"
        elif "control_process" not in parameters(runner):
            obstacle = f"{name} takes no control_process"
        elif RUNNERS.registered(table["type"]) is not None and import_path(runner) is None:
            obstacle = f"{name} is defined where no other process can import it"
        elif more:
            obstacle = f"{name} also has a {more[0]} of its own"
        return cls(
            name, bool(defined & {*_SENDING}), bool(defined & {*_OBSERVING}), table, obstacle
        )

    @property
    def why_single_process(self) -> str | None:
        """Why its methods keep the operator in this process; None if they do not."""
        if self.obstacle is None or not (self.sends or self.observes):
            return None
        method = "sends commands" if self.sends else "reads the robot"
        return f"{self.runner} {method} by a method of its own, and {self.obstacle}"


def choose_layout(
    build: Callable[[], Any],
    tables: ControlTables,
    config: Mapping[str, Any],
    embodiment: Embodiment,
    overrides: RunnerOverrides,
    obstacle: str | None,
) -> ProcessLayout:
    """Choose which process commands a robot.

    Args:
        build: builds the operator in this process; it is not connected by that, if it has a
            ``connect``. One that has none is built only where it is to run.
        tables: what it is built from, or objects.
        config: the whole config.
        embodiment: what the config says of the robot.
        overrides: the runner's.
        obstacle: why this process is to command it; None where that depends on the rest.

    Raises:
        ConfigError, PluginError: the operator cannot be built, or lacks something.
    """
    obstacle = (
        obstacle
        or _obstacle(tables, config)
        or (overrides.why_single_process if overrides.sends else None)
    )
    # ``build`` reports unknown operators.
    name: str = "" if obstacle else tables.operator.get("type", "")
    cls = OPERATORS.get(name) if name in OPERATORS else None
    known = None if cls is None else _embodiment_before_connect(cls, embodiment)
    if cls is not None and known is not None and overrides.why_single_process is None:
        return _undivided(RemoteOperator(cls.__name__, known), embodiment, cls, tables, overrides)
    made = build()
    operator = Operator.adapt(made)
    if obstacle is None and in_lockstep(clock_of(operator)):
        obstacle = "the time of this simulation stands still between commands"
    if obstacle is not None:
        return ProcessLayout(
            made, Robot(made, embodiment, overrides.sends), why_single_process=obstacle
        )
    if implements(made, Operator, "without_cameras") and not overrides.sends:
        part = operator.without_commands()
        if part is not None:
            return ProcessLayout(part, Robot(part, embodiment), tables)
    # All that is wrong with it is found here, before another process is started.
    robot = Robot(made, embodiment, overrides.sends)
    obstacle = overrides.why_single_process or _why_single_process(robot, operator)
    if obstacle is not None:
        return ProcessLayout(made, robot, why_single_process=obstacle)
    stand_in = RemoteOperator(robot.name, robot.embodiment, operator.domain_id)
    return _undivided(stand_in, None, type(made), tables, overrides)


def _undivided(
    remote_operator: RemoteOperator,
    embodiment: Embodiment,
    cls: type,
    tables: ControlTables,
    overrides: RunnerOverrides,
) -> ProcessLayout:
    runner = None
    if overrides.table is not None and (overrides.sends or overrides.observes):
        given = {"operator": tables.operator} if "operator" in overrides.table else {}
        runner = {**overrides.table, **given}
    robot = Robot(remote_operator, embodiment, overrides.sends, kind=cls)
    return ProcessLayout(
        remote_operator, robot, tables, remote_operator=remote_operator, runner=runner
    )


def _embodiment_before_connect(cls: type, embodiment: Embodiment) -> EmbodimentSpec | None:
    """The embodiment of an operator that connects in its constructor, as far as it is known."""
    if implements(cls, Operator, "connect"):
        return None
    own = getattr(cls, "embodiment", None)
    if isinstance(own, EmbodimentSpec):
        return own
    return EmbodimentSpec.from_dict(embodiment) if isinstance(embodiment, Mapping) else embodiment


def _why_single_process(robot: Robot, operator: Operator) -> str | None:
    """Why an operator that cannot be divided does not run as a whole in another process."""
    name = robot.name
    if not robot.follows_commands:
        return f"{name} is a recording, which does not execute commands"
    if not isinstance(robot.clock, MonotonicClock):
        return f"{name} cannot be divided, and has a clock of its own"
    if not implements(operator, Operator, "connect"):
        return f"{name} connects in its constructor, and the config has no embodiment for it"
    return None


def _obstacle(tables: ControlTables, config: Mapping[str, Any]) -> str | None:
    if sys.platform != "linux":
        return "this system has no memory that two processes share by a descriptor"
    for registry, built in ((OPERATORS, [tables.operator]), (ACTION_FILTERS, tables.filters)):
        for each in built:
            if not isinstance(each, Mapping):
                return f"{type(each).__name__} is an object, not a table"
            cls = registry.registered(each.get("type", ""))
            if cls is not None and import_path(cls) is None:
                return f"{each['type']} is defined where no other process can import it"
    values = {
        "operator": tables.operator,
        "action_filters": tables.filters,
        "config": config,
    }
    return next(filter(None, (not_plain(value, key) for key, value in values.items())), None)
