"""``make_engine``: the object that commands a robot, with a control process or without."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from fluxvla_core.build import RunContext
from fluxvla_core.contracts.policy import Policy
from fluxvla_core.contracts.robot import ActionFilter
from fluxvla_core.robot.control.interrupt import Interrupts
from fluxvla_core.robot.control.joiners import make_joiner
from fluxvla_core.robot.control.safety import Latch
from fluxvla_core.robot.control.sender import Execute
from fluxvla_core.robot.control.tracking import TrackingWatch
from fluxvla_core.robot.engine import Engine, LocalEngine, RunHistory
from fluxvla_core.robot.episode import EpisodeParts, EpisodeSettings
from fluxvla_core.robot.events import Event
from fluxvla_core.robot.local_policy_client import LocalPolicyClient
from fluxvla_core.robot.observation import ObservationReader, Observe
from fluxvla_core.robot.policy_calls import PolicyCaller, PolicyThread
from fluxvla_core.robot.process.remote_engine import RemoteEngine
from fluxvla_core.robot.process.setup import ControlSetup, registered_here
from fluxvla_core.robot.process_layout import ProcessLayout
from fluxvla_core.robot.robot import Robot
from fluxvla_core.robot.tasks import Task


@dataclass(frozen=True)
class RunParts:
    """The objects and settings of a run.

    Args:
        robot: not connected; where another process commands it, the part without commands.
        policy: loaded, and fitting the robot.
        observe: makes an observation of the robot's newest frame.
        cameras: names of the cameras that the policy looks at.
        ready_s: seconds that the robot may take to give its first reading.
        filters: the config's ``action_filters``.
        joining: the config's ``chunk_joining``, and the seconds between two observations.
        execute: sends commands: ``(N, D)`` and the rate.
        settings: how episodes are driven.
        latch: an episode does not begin while it is tripped.
        context: of the run.
        history: of the runner's earlier runs.
    """

    robot: Robot
    policy: Policy
    observe: Observe
    cameras: tuple[str, ...]
    ready_s: float
    filters: Sequence[ActionFilter]
    joining: tuple[Any, float]
    execute: Execute
    settings: EpisodeSettings
    latch: Latch
    context: RunContext
    history: RunHistory


def make_engine(
    parts: RunParts, layout: ProcessLayout, interrupts: Interrupts, thread: PolicyThread
) -> Engine:
    """The engine of one run: ``RemoteEngine`` with a control process, else ``LocalEngine``.

    Args:
        parts: what the run drives the robot with.
        layout: whether another process commands the robot.
        interrupts: signals that ask the run to end.
        thread: the thread in which the policy computes.
    """
    robot, policy, settings, safety = (
        parts.robot,
        parts.policy,
        parts.settings,
        parts.settings.safety,
    )

    observe = parts.observe
    if layout.frames is not None and layout.runner is not None:
        observe = layout.frames.observe

    def make_client(
        task: Task, seed: int, tracking: TrackingWatch, emit: Callable[[Event], None]
    ) -> LocalPolicyClient:
        reader = ObservationReader(
            robot, observe, task.instruction, parts.cameras, safety, parts.ready_s,
            tracking, thread, interrupts, emit,
        )  # fmt: skip
        caller = PolicyCaller(policy, robot.embodiment, safety, robot.delays, seed)
        return LocalPolicyClient(robot, reader, caller, thread, emit)

    reporter, latch, history = parts.context.reporter, parts.latch, parts.history
    tables, frames = layout.tables, layout.frames
    if tables is not None:
        setup = ControlSetup(
            config=parts.context.config,
            section=parts.context.section,
            work_dir=str(parts.context.work_dir),
            operator=tables.operator,
            embodiment=robot.embodiment.to_dict(),
            filters=tables.filters,
            gripper_threshold=tables.gripper_threshold,
            joining=parts.joining,
            settings=settings,
            before=history.commanded,
            python_path=sys.path,
            registered=registered_here(tables.operator, tables.filters, layout.runner),
            cameras=None if frames is None else parts.cameras,
            runner=layout.runner,
        )
        return RemoteEngine(setup, robot, make_client, latch, interrupts, reporter, history, frames)
    joiner, filters = make_joiner(*parts.joining), parts.filters
    episode = EpisodeParts(
        robot, make_client, filters, joiner, parts.execute, latch, interrupts, reporter
    )
    return LocalEngine(episode, settings, history)
