"""Replay: ``ReplayOperator`` is a recorded robot, ``ReplayPolicy`` a recorded policy.

The same config runs in simulation, on a recording or on the robot by changing ``operator``.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from fluxvla_core.build import RunContext
from fluxvla_core.contracts.frame import STATE, Observation
from fluxvla_core.contracts.policy import Continuation, Policy
from fluxvla_core.contracts.robot import Clock, Operator
from fluxvla_core.control.clock import MonotonicClock, SimulatedClock
from fluxvla_core.control.policy_client import PolicyEnded
from fluxvla_core.errors import ConfigError, DataError, NotReady
from fluxvla_core.robot.recording import episode_log
from fluxvla_core.robot.recording.recorded import (
    ROUNDING_S,
    Event,
    RecordedEpisode,
    age_at,
    newest_at,
    open_recording,
)
from fluxvla_core.robot.recording.ros_messages import BASE
from fluxvla_core.ros2 import RobotFrame, checked_action, depth_stream
from fluxvla_core.spec import EmbodimentSpec

Array = npt.NDArray[np.float64]
CHUNKS, COMMANDS = "chunks", "commands"
ENDED = "recording_ended"
"""An episode's outcome."""


class ReplayOperator(Operator):
    """Shows what was recorded, and takes commands without following them.

    As fast as possible by default: it has a clock of its own, on which each command takes a
    control period, as in a simulation. A policy that answers as it did gives the same episode.

    Args:
        recording: an episode's folder or MCAP file, of ``fluxvla run --record``.
        realtime: at the pace at which it was recorded.
        context: what the run knows (injected): its reporter learns when the recording ends.
    """

    api: ClassVar[str] = "1.0"
    # Its tracking error is the difference between two policies, not a fault.
    follows_commands: ClassVar[bool] = False

    def __init__(
        self, recording: str, realtime: bool = False, context: RunContext | None = None
    ) -> None:
        self.recording = recording
        self.realtime = realtime
        self._reporter = (context or RunContext()).reporter
        self._connected = False
        self._ended = False
        self._began = 0.0

    @cached_property
    def recorded(self) -> RecordedEpisode:
        """The recording, read when it is first needed.

        Raises:
            DataError: it cannot be read, or has nothing to show.
        """
        found = open_recording(self.recording)
        if found.embodiment.cameras and not found.images:
            raise DataError(
                "this episode has no images: its robot cannot be replayed",
                where=str(found.path),
                cause="it was run without --record",
                next="ReplayPolicy can replay its actions; record again with --record DIR",
            )
        return found

    @cached_property
    def embodiment(self) -> EmbodimentSpec:
        """The recorded robot, with those of its cameras that were recorded."""
        spec = self.recorded.embodiment
        seen = tuple(c for c in spec.cameras if c.name in self.recorded.images)
        return replace(spec, cameras=seen)

    @cached_property
    def clock(self) -> Clock:
        """Real time, or a clock that begins when the recording did."""
        return MonotonicClock() if self.realtime else SimulatedClock(self._first)

    def connect(self) -> None:
        """Go to the beginning."""
        self._connected = True
        self._rewind()

    def begin_episode(self, instruction: str, episode: int) -> None:
        """Go to the beginning, and say so if another task was recorded."""
        self._rewind()
        if instruction != self.recorded.instruction:
            self._reporter.warn(
                f"the recording {self.recorded.path} is of {self.recorded.instruction!r}, "
                f"not of {instruction!r}"
            )

    def get_frame(self) -> RobotFrame:
        """The matched state and images of this moment, in new arrays; depth and base if recorded.

        Streams are as late, and as far apart, as they were when the robot was looked at last. No
        stream runs backwards: the recorded looks bound what is shown between them.

        Raises:
            NotReady: not connected.
        """
        now = self._now()
        look = int(newest_at(self._looked, now))
        arrived = {stream: self._arrived(stream, look, now) for stream in self._arrivals}
        cameras, depths = self.recorded.images, self.recorded.depths
        images = {name: found.shown(arrived[name]) for name, found in cameras.items()}
        metres = {name: found.shown(arrived[depth_stream(name)]) for name, found in depths.items()}
        base = self._observations[look].get(BASE)
        # One shift for all: differences of two clock readings would let a stream run backwards.
        shift = self._began - self._first
        return RobotFrame(
            self._state(arrived[STATE]),
            images,
            {stream: stamp + shift for stream, stamp in arrived.items()},
            metres,
            None if base is None else np.array(base, dtype=np.float64),
        )

    def get_state(self) -> Array:
        """``(state_dim,)``, the newest of now.

        Raises:
            NotReady: not connected.
        """
        return self._state(self._now())

    def send_action(self, action: npt.ArrayLike) -> None:
        """Take a ``(dim,)`` command; without ``realtime`` a control period passes.

        Raises:
            NotReady: not connected.
            Rejected: wrong shape, not finite, or outside the limits.
        """
        self._now()
        checked_action(self.embodiment, action)
        if isinstance(self.clock, SimulatedClock):
            self.clock.advance(1.0 / self.embodiment.rate_hz)

    def task_done(self) -> bool:
        """Whether the recording is over, which is reported once."""
        over = self._now() >= self._last - ROUNDING_S
        if over and not self._ended:
            self._ended = True
            cut = "" if self.recorded.finished else ", where it was cut short"
            self._reporter.info(f"the recording {self.recorded.path} ends here{cut}")
        return over

    def stop(self) -> None:
        """Nothing moves."""

    def close(self) -> None:
        """Forget the connection; any number of times."""
        self._connected = False

    def _rewind(self) -> None:
        self._began, self._ended = self.clock.now(), False

    def _now(self) -> float:
        """Seconds on the recorded loop's clock."""
        if not self._connected:
            raise NotReady("the recording is not connected", next="call connect() first")
        return self._first + (self.clock.now() - self._began)

    @cached_property
    def _first(self) -> float:
        return float(self._observations[0]["t"])

    @cached_property
    def _last(self) -> float:
        """When the last command of the task was done; how the arm came to rest is no part of it."""
        times, _ = self.recorded.commands("run")
        return float(times[-1]) if len(times) else float(self._observations[-1]["t"])

    @cached_property
    def _observations(self) -> list[Event]:
        # A policy's history is recorded with the question that needs it, in the order of that.
        found = sorted(self.recorded.of(episode_log.OBSERVATION), key=lambda event: event["t"])
        if not found:
            raise DataError(
                "the recording holds no observation of the robot", where=str(self.recorded.path)
            )
        return found

    @cached_property
    def _looked(self) -> Array:
        """``(N,)`` when the robot was looked at."""
        return np.array([event["t"] for event in self._observations], dtype=np.float64)

    @cached_property
    def _arrivals(self) -> dict[str, Array]:
        """Stream -> ``(N,)`` when what each look saw of it had arrived."""
        recorded = self.recorded
        streams = [STATE, *recorded.images, *map(depth_stream, recorded.depths)]
        ages = {s: np.array([age_at(e, s) for e in self._observations]) for s in streams}
        # The loop checks the streams that its policy looks at; the others may have run backwards.
        return {s: np.maximum.accumulate(self._looked - age) for s, age in ages.items()}

    def _arrived(self, stream: str, look: int, now: float) -> float:
        """When what is shown ``now`` of a stream had arrived: ``look`` is the last one before."""
        arrivals = self._arrivals[stream]
        age = self._looked[look] - arrivals[look]
        latest = arrivals[look + 1] if look + 1 < len(arrivals) else np.inf
        return float(np.clip(now - age, arrivals[look], latest))

    @cached_property
    def _states(self) -> tuple[Array, Array]:
        return self.recorded.states()

    def _state(self, time: float) -> Array:
        times, states = self._states
        return np.array(states[newest_at(times, time)])


class RecordingEnded(PolicyEnded):
    """A replayed policy has no answer left."""

    outcome = ENDED


class ReplayPolicy(Policy):
    """Gives the recorded answers, whatever it is shown; after the last one the episode ends.

    ``chunks`` repeats the policy: its n-th answer again at the n-th question. From the same start
    and with the same runner settings that gives the same commands; a runner that asks more often,
    or less often, than the recorded one plays less of each answer, or more. ``commands`` repeats
    the motion with any settings: all commands of the task as one chunk, played to its end. The
    runner's safety is the same as for any policy.

    Args:
        recording: an episode's folder, with or without images, or its MCAP file.
        actions: ``chunks`` or ``commands``.
        context: what the run knows (injected): its reporter learns when the recording ends.

    Raises:
        ConfigError: ``actions`` is neither.
    """

    cameras: tuple[str, ...] = ()
    """It looks at none."""

    def __init__(
        self, recording: str, actions: str = CHUNKS, context: RunContext | None = None
    ) -> None:
        if actions not in (CHUNKS, COMMANDS):
            raise ConfigError(f"actions {actions!r} is neither {CHUNKS!r} nor {COMMANDS!r}")
        self.recording = recording
        self.actions = actions
        self._reporter = (context or RunContext()).reporter
        self._next = 0

    @cached_property
    def recorded(self) -> RecordedEpisode:
        """The recording, read when it is first needed.

        Raises:
            DataError: it cannot be read.
        """
        return open_recording(self.recording)

    @property
    def embodiment(self) -> EmbodimentSpec:
        """The recorded robot."""
        return self.recorded.embodiment

    @property
    def action_rate_hz(self) -> float:
        """Actions a second."""
        key = "action_rate_hz" if self.actions == CHUNKS else "rate_hz"
        return float(self.recorded.start[key])

    @property
    def horizon(self) -> int:
        """Actions of a chunk."""
        return len(self._chunks[0])

    @property
    def whole_motion(self) -> bool:
        """Whether its one chunk is all that there is to do."""
        return self.actions == COMMANDS

    def reset(self, seed: int) -> None:
        """Reset; nothing is drawn."""
        self._next = 0

    def predict_action(self, observation: Observation) -> Array:
        """``(horizon, dim)``: the next answer.

        Raises:
            RecordingEnded: there is none left; a robot's episode ends well with it.
        """
        if self._next >= len(self._chunks):
            cut = "" if self.recorded.finished else ", where it was cut short"
            text = f"the recording {self.recorded.path} ends here{cut}"
            self._reporter.info(text)
            raise RecordingEnded(text)
        self._next += 1
        return self._chunks[self._next - 1].copy()

    def continue_action(self, observation: Observation, rest: Continuation) -> Array:
        """The next answer, whatever it had to continue when it was recorded."""
        return self.predict_action(observation)

    @cached_property
    def _chunks(self) -> list[Array]:
        recorded = self.recorded
        if self.actions == CHUNKS:
            found = recorded.chunks()
        else:
            commands = recorded.commands("run")[1]
            found = [commands] if len(commands) else []
        if not found:
            raise DataError(
                f"the recording holds no {self.actions}: nothing was done in it",
                where=str(recorded.path),
            )
        return found
