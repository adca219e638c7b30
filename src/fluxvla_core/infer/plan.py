"""What a runner gives each of its episodes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.build import RunContext
from fluxvla_core.contracts.frame import Frame
from fluxvla_core.contracts.protocols import Policy
from fluxvla_core.control.interrupt import Interrupts
from fluxvla_core.control.joining import Joiner
from fluxvla_core.control.path import Execute, Filter
from fluxvla_core.control.worker import Worker
from fluxvla_core.errors import RunFailed
from fluxvla_core.hooks import HookCaller
from fluxvla_core.infer.robot import Robot
from fluxvla_core.safety.settings import SafetySettings
from fluxvla_core.safety.stops import BadChunk
from fluxvla_core.safety.trips import Latch


class PolicyFailed(RunFailed):
    """A policy raised something; ``rule`` is for the latch and the record."""

    rule = "policy"


@dataclass(frozen=True)
class Answer:
    """What a policy said.

    Args:
        chunk: as it came.
        seconds: how long it took.
        keyframes: ``(T, D)`` of it, read-only, or why they are refused.
    """

    chunk: Any
    seconds: float
    keyframes: npt.NDArray[np.float64] | BadChunk


@dataclass(frozen=True)
class Plan:
    """What the runner gives each of its episodes.

    Args:
        robot, policy: connected, loaded, and fitting each other.
        cameras: names of those that the policy looks at.
        seed: of the first episode's policy; each later one adds 1.
        rate_hz: commands a second.
        settings: thresholds of the safety rules.
        latch: of the run; an episode does not begin while it is tripped.
        filters: the config's ``action_filters``.
        joiner: how chunks become one motion.
        latency_s: how long, in a simulation whose time stands still, an answer takes.
        keyframes: how many of a chunk's keyframes are played; None plays all.
        most_steps: commands after which the episode ends.
        start_pose: ``(D,)``, where the arm goes first; None stays.
        look: makes an observation and, if it can, the frame that it is made of.
        execute: sends commands: ``(N, D)`` and the rate.
        video_fps: of the recorded videos; None records none.
        record: whether everything is recorded, pictures too.
        ready_s: how long the robot may take to give its first reading.
        interrupts, worker, hooks, context: of the run.
    """

    robot: Robot
    policy: Policy
    cameras: tuple[str, ...]
    seed: int
    rate_hz: float
    settings: SafetySettings
    latch: Latch
    filters: Sequence[Filter]
    joiner: Joiner
    latency_s: float
    keyframes: int | None
    most_steps: int
    start_pose: Sequence[float] | None
    look: Callable[[], tuple[dict[str, Any], Frame | None]]
    execute: Execute
    video_fps: float | None
    record: bool
    ready_s: float
    interrupts: Interrupts
    worker: Worker
    hooks: HookCaller
    context: RunContext
