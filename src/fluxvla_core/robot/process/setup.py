"""``ControlSetup``: everything that the control process is built from, as JSON."""

from __future__ import annotations

import importlib
import json
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from fluxvla_core.build import (
    RunContext,
    build_operator_from_cfg,
    build_runner_from_cfg,
)
from fluxvla_core.contracts.robot import ActionFilter, Operator
from fluxvla_core.contracts.runner import Reporter
from fluxvla_core.control.safety import SafetySettings
from fluxvla_core.control.sender import ExecuteActions
from fluxvla_core.plugins.registry import (
    ACTION_FILTERS,
    BY_NAME,
    OPERATORS,
    RUNNERS,
    load_plugin_files,
    plugin_files,
)
from fluxvla_core.robot.episode import EpisodeSettings
from fluxvla_core.robot.options import build_filters
from fluxvla_core.robot.process.undivided_robot import UndividedRobot
from fluxvla_core.robot.robot import Robot
from fluxvla_core.spec import EmbodimentSpec


@dataclass(frozen=True)
class ControlSetup:
    """The settings of a run that both processes have.

    Args:
        config: the whole config; for classes that ask for it.
        section: the section that runs.
        work_dir: of the run.
        operator: the operator's table.
        embodiment: of the robot, as ``EmbodimentSpec.to_dict`` has it.
        filters: tables of the action filters.
        gripper_threshold: as the runner has it.
        joining: the config's ``chunk_joining``, and the seconds between two observations.
        settings: how episodes are driven.
        before: ``(D,)`` the last command of an earlier run; None before any.
        python_path: where modules are found.
        registered: of the operator and the filters those that the main process registered itself:
            registry, name and import path.
        plugin_files: of ``--plugin``, which register their classes; those of this process.
        cameras: of an operator that runs as a whole in the control process: names of the cameras
            that the main process is shown. None where it is divided.
        runner: table of a runner that sends commands, or makes observations, by methods of its own:
            it is built here too, without a policy. None where there is none.
        main: the main process's id.
    """

    config: Mapping[str, Any]
    section: str
    work_dir: str
    operator: Mapping[str, Any]
    embodiment: Mapping[str, Any]
    filters: Sequence[Mapping[str, Any]]
    gripper_threshold: float | None
    joining: tuple[Any, float]
    settings: EpisodeSettings
    before: Any
    python_path: Sequence[str] = ()
    registered: Sequence[tuple[str, str, str]] = ()
    plugin_files: Sequence[str] = field(default_factory=plugin_files)
    cameras: Sequence[str] | None = None
    runner: Mapping[str, Any] | None = None
    main: int = field(default_factory=os.getpid)

    def to_json(self) -> str:
        """As JSON.

        Raises:
            TypeError: a value of the config is an object.
        """
        return json.dumps(asdict(self), default=_plain)

    @classmethod
    def from_json(cls, text: str) -> ControlSetup:
        """The inverse of ``to_json``."""
        values = json.loads(text)
        settings = values.pop("settings")
        settings["safety"] = SafetySettings(**settings["safety"])
        values["joining"] = tuple(values["joining"])
        return cls(settings=EpisodeSettings(**settings), **values)

    def make_robot(self, reporter: Reporter) -> Robot:
        """The robot that this process commands; not connected.

        Raises:
            ConfigError, PluginError: the operator cannot be built.
        """
        return self.build_control_side(reporter)[0]

    def build_control_side(self, reporter: Reporter) -> tuple[Robot, ExecuteActions]:
        """The robot that this process commands, not connected, and what sends the commands.

        Raises:
            ConfigError, PluginError: the operator, or the runner, cannot be built.
        """
        self._import_registered()
        if self.runner is not None:
            runner = build_runner_from_cfg(self.runner, self._context(reporter))
            robot = UndividedRobot(runner.ros_operator, self._spec(), runner_sends=True)
            execute_actions, observe = runner.control_side(robot, self.cameras or ())
            robot.observed_by(observe)
            return robot, execute_actions
        made = self._operators_robot(reporter)
        return made, made.send_actions

    def _operators_robot(self, reporter: Reporter) -> Robot:
        built = build_operator_from_cfg(self.operator, self._context(reporter))
        if self.cameras is not None:
            return UndividedRobot(built, self._spec())
        return Robot(Operator.adapt(built).without_cameras() or built, self._spec())

    def make_filters(self, reporter: Reporter) -> list[ActionFilter]:
        """The action filters, bound to the robot.

        Raises:
            ConfigError, PluginError: one of them cannot be built, or does not fit.
        """
        context = self._context(reporter)
        return build_filters(self.filters, self.gripper_threshold, self._spec(), context)

    def _import_registered(self) -> None:
        known = set(sys.path)
        sys.path += [folder for folder in self.python_path if folder not in known]
        there = plugin_files()
        load_plugin_files(file for file in self.plugin_files if file not in there)
        for name, registered, path in self.registered:
            module, _, qualified = path.partition(":")
            registry = BY_NAME[name]
            if registry.registered(registered) is None:
                cls = attrgetter(qualified)(importlib.import_module(module))
                registry.register_module(registered)(cls)

    def _spec(self) -> EmbodimentSpec:
        return EmbodimentSpec.from_dict(self.embodiment)

    def _context(self, reporter: Reporter) -> RunContext:
        return RunContext(
            config=self.config,
            section=self.section,
            work_dir=Path(self.work_dir),
            reporter=reporter,
        )


def registered_here(
    operator: Mapping[str, Any],
    filters: Sequence[Mapping[str, Any]],
    runner: Mapping[str, Any] | None = None,
) -> list[tuple[str, str, str]]:
    """``ControlSetup.registered`` for these tables."""
    tables = [(OPERATORS, operator), *((ACTION_FILTERS, table) for table in filters)]
    tables += [] if runner is None else [(RUNNERS, runner)]
    found = [(reg.name, t["type"], reg.registered(t["type"])) for reg, t in tables]
    paths = [(registry, name, import_path(cls)) for registry, name, cls in found if cls]
    return [(registry, name, path) for registry, name, path in paths if path]


def import_path(cls: Any) -> str | None:
    """``module:Class`` under which another process finds the class; None if it does not."""
    path = f"{cls.__module__}:{cls.__qualname__}"
    hidden = cls.__module__ == "__main__" or "<" in cls.__qualname__
    return None if hidden or not _is_found(cls.__module__) else path


def _is_found(module: str) -> bool:
    """Whether a fresh interpreter finds ``module``, which this one has."""
    loaded = getattr(sys.modules.get(module), "__file__", None)
    if loaded is not None and str(Path(loaded).resolve()) in plugin_files():
        return True
    # ``find_spec`` alone believes in whatever was imported once.
    top = module.partition(".")[0]
    if not any(finder.find_spec(top, None) for finder in sys.meta_path):
        return False
    try:
        return find_spec(module) is not None
    except (ImportError, ValueError):
        return False


def not_plain(value: Any, key: str) -> str | None:
    """What in ``value`` (at ``key``) cannot be sent to another process; None if nothing."""
    if isinstance(value, Mapping):
        strange = [name for name in value if not isinstance(name, str)]
        if strange:
            return f"{key} has a key that is not text: {strange[0]!r}"
        return _first(not_plain(inner, f"{key}.{name}") for name, inner in value.items())
    if isinstance(value, (list, tuple)):
        return _first(not_plain(inner, f"{key}.{index}") for index, inner in enumerate(value))
    plain = (str, int, float, type(None), Path, np.ndarray, np.generic)
    return None if isinstance(value, plain) else f"{key} is an object"


def _first(found: Iterable[str | None]) -> str | None:
    return next((text for text in found if text is not None), None)


def _plain(value: Any) -> Any:
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{value!r} is an object; a process of its own takes tables alone")
