"""Typed events of an episode, and the observers that receive them.

The episode engine emits events and knows nothing of files or plugins: an observer writes the
record, another calls the plugins' hooks. Observers are called in order, in the thread that emits;
what one raises ends the episode as any other error does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.frame import Frame
from fluxvla_core.control.safety import Trip
from fluxvla_core.control.sender import SentCommand
from fluxvla_core.hooks import HookCaller
from fluxvla_core.robot.tasks import Task

Array = npt.NDArray[np.float64]


class Phase(str, Enum):
    """The phase of an episode, as its record names it."""

    __str__ = str.__str__  # its value, also in Python 3.10, which has no StrEnum

    START = "start"
    RAMP = "ramp"
    READY = "ready"
    RUN = "run"
    HOLD = "hold"
    STOP = "stop"
    OVER = "over"

    @property
    def moving(self) -> bool:
        """Whether the arm moves by a plan: to the start pose, or as the policy says."""
        return self in (Phase.RAMP, Phase.RUN)

    @property
    def stoppable(self) -> bool:
        """Whether what goes wrong with the robot still has to stop it."""
        return self.moving or self is Phase.READY


@dataclass(frozen=True)
class ObservedFrame:
    """One observation of the robot, with its frame, state and times (s) on the robot's clock.

    Args:
        observation: as the operator gave it, with the instruction.
        frame: the operator's frame that it was made of; None if the operator has no frames.
        state: ``(state_dim,)``.
        measured: when the state arrived.
        at: when the oldest of its streams arrived.
        seconds: duration of each stage of making it.
    """

    observation: dict[str, Any]
    frame: Frame | None
    state: Array
    measured: float
    at: float
    seconds: Mapping[str, float]


@dataclass(frozen=True)
class Event:
    """``at``: seconds on the robot's clock."""

    at: float


@dataclass(frozen=True)
class EpisodePrepared(Event):
    """An episode is about to begin, nothing moves yet; if an observer raises, it does not begin."""

    task: Task
    seed: int
    rate_hz: float


@dataclass(frozen=True)
class EpisodeStarted(Event):
    """The episode has begun: from here on whatever goes wrong stops the robot."""

    task: Task


@dataclass(frozen=True)
class Observed(Event):
    """An observation passed its checks."""

    observed: ObservedFrame


@dataclass(frozen=True)
class HistoryObserved(Event):
    """An observation made between two queries, now that a query uses it as history.

    ``at`` is when it was made, which is before other events that came first.
    """

    observed: ObservedFrame


@dataclass(frozen=True)
class Refused(Event):
    """An ``observation`` or a ``chunk`` (``what``) did not pass its checks; any values."""

    what: str
    values: Mapping[str, Any]


@dataclass(frozen=True)
class ChunkAccepted(Event):
    """The policy's answer to a query: ``(T, D)`` actions, read-only; and seconds by stage."""

    observed: ObservedFrame
    actions: Array
    stages: Mapping[str, float]


@dataclass(frozen=True)
class CommandSent(Event):
    """One command, with the ``(state_dim,)`` state if it was read at this tick.

    ``send_s`` is what sending took, if it is known, ``late_s`` how late it was.
    """

    sent: SentCommand
    phase: Phase
    state: Array | None
    send_s: float | None
    late_s: float


@dataclass(frozen=True)
class FilterSkipped(Event):
    """The action filter called ``name`` was late, and is left out of the command that comes next.

    After too many in a row there is none: the arm is stopped."""

    name: str


@dataclass(frozen=True)
class Stopped(Event):
    """A safe stop took place: why, how long it took, and what went wrong with it."""

    rule: str
    problem: str
    seconds: float
    failure: str | None


@dataclass(frozen=True)
class StoppedWhileHeld(Event):
    """A stop after the episode, while its last command held the arm; its record is complete."""

    trip: Trip
    failure: str | None


@dataclass(frozen=True)
class EpisodeEnded(Event):
    """The end of an episode; ``problem`` ended it early, ``skipped`` ticks were missed."""

    outcome: str
    success: bool | None
    problem: str | None
    skipped: int
    trips: Sequence[Trip]


class EpisodeObserver:
    """Base class of what receives every event of an episode."""

    def on_event(self, event: Event) -> None:
        """Called with each event; arrays must not be changed."""


class HookObserver(EpisodeObserver):
    """Calls the plugins' hooks.

    Args:
        hooks: the hooks of the run.
    """

    def __init__(self, hooks: HookCaller) -> None:
        self._hooks = hooks

    def on_event(self, event: Event) -> None:
        if not self._hooks:
            return
        match event:
            case EpisodeStarted(at=at, task=task):
                self._hooks.call("episode_started", task=task.instruction, stamp=at)
            case ChunkAccepted(at=at, observed=observed, actions=chunk, stages=stages):
                shown = _frozen(observed.observation)
                self._hooks.call("observed", observation=shown, stamp=observed.measured)
                latency = stages["policy"]
                self._hooks.call("inferred", chunk=chunk, latency_s=latency, stamp=at)
            case CommandSent(at=at, sent=sent, state=state):
                self._hooks.call(
                    "action_sent",
                    action=_kept(sent.command),
                    stamp=at,
                    target=_kept(sent.target),
                    state=None if state is None else _kept(state),
                )
            case Stopped(at=at, rule=rule, problem=problem):
                self._hooks.call("stopped", rule=rule, problem=problem, stamp=at)
            case StoppedWhileHeld(at=at, trip=trip):
                self._hooks.call("stopped", rule=trip.rule, problem=trip.what, stamp=at)
            case EpisodeEnded(at=at, problem=problem, outcome=outcome):
                self._hooks.call("episode_finished", reason=problem or outcome, stamp=at)


def _kept(array: Array) -> Array:
    """A read-only copy: hooks see it when the loop may have gone on."""
    copy = array.copy()
    copy.flags.writeable = False
    return copy


def _frozen(observation: dict[str, Any]) -> dict[str, Any]:
    """The observation with its arrays read-only: hooks look, they do not touch."""
    images = {name: image.view() for name, image in observation["images"].items()}
    shown = {**observation, "qpos": np.asarray(observation["qpos"]).view(), "images": images}
    for array in (shown["qpos"], *images.values()):
        array.flags.writeable = False
    return shown
