"""Inference in an episode: read an observation, check it, query the policy, check its chunk.

On a robot all of it happens in a thread of its own (``PolicyThread``), so that the one that sends
commands never waits for a camera or a policy. How old an observation may be for the policy
(``safety.max_age_s``) is checked here, for every kind of operator.
"""

from __future__ import annotations

import math
import time
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.frame import STATE, Frame, Observation
from fluxvla_core.contracts.policy import Policy
from fluxvla_core.control.chunks import check_chunk
from fluxvla_core.control.delays import POLICY, DelaySource
from fluxvla_core.control.interrupt import Interrupts
from fluxvla_core.control.joiners import PreviousChunk
from fluxvla_core.control.policy_client import Answer, PolicyClient, PolicyFailed
from fluxvla_core.control.safety import BadChunk, BadFrame, BadTiming, SafetySettings
from fluxvla_core.control.tracking import TrackingWatch
from fluxvla_core.errors import FluxError, NotReady
from fluxvla_core.robot.events import ChunkAccepted, Event, Observed, Refused, RobotReading
from fluxvla_core.robot.observation_history import ObservationHistory
from fluxvla_core.robot.operator_values import check_frame, is_number
from fluxvla_core.robot.policy_thread import PolicyThread
from fluxvla_core.robot.robot import Observe, Robot

Array = npt.NDArray[np.float64]

_READ_TIMEOUT_S = 0.5  # the least time that the first reading is given
_LONG_S = 0.1  # a reading that takes longer makes its own streams old

# A stamp may be this far in the future: the reading was taken while its age was computed.
AHEAD_S = 0.005


@dataclass(frozen=True)
class PolicyAnswer(Answer):
    """A policy's answer to a reading, as it came.

    Args:
        reading: that it was asked with.
        chunk: as it came.
        stages: seconds, by stage; ``policy`` is all of it.
    """

    reading: RobotReading
    chunk: Any
    stages: Mapping[str, float]


class LocalPolicyClient(PolicyClient):
    """Observes a robot and queries a policy of this process, in one episode.

    On a robot both happen in the policy's thread. In a lockstep simulation observing happens in the
    thread that sends commands: renderers are bound to one.

    Args:
        robot: the connected robot.
        reader: reads the robot's observations.
        history: keeps those of before, for a policy that acts on several.
        policy: answers them with chunks; loaded.
        seed: the policy's in this episode.
        thread: the thread in which the policy computes.
        safety: thresholds of the checks of chunks.
        emit: takes the events ``ChunkAccepted`` and ``Refused``.
    """

    def __init__(
        self,
        robot: Robot,
        reader: ObservationReader,
        history: ObservationHistory,
        policy: Policy,
        seed: int,
        thread: PolicyThread,
        safety: SafetySettings,
        emit: Callable[[Event], None],
    ) -> None:
        self._robot = robot
        self._reader = reader
        self._history = history
        self._policy = policy
        self._seed = seed
        self._thread = thread
        self._safety = safety
        self._emit = emit

    def first_state(self) -> Array:
        return self._reader.first().state

    def reset(self) -> None:
        try:
            with self._robot.delays.of(POLICY):
                self._policy.reset(self._seed)
        except FluxError:
            raise
        except (Exception, SystemExit) as error:
            raise PolicyFailed(
                f"the policy raised {type(error).__name__} in reset(): {error}"
            ) from error
        self._history.reset()

    def ask(self, previous: PreviousChunk | None) -> Future[Answer]:
        if self._robot.lockstep:
            reading, seen = self._history.read()
            return self._thread.submit(lambda: self._predict(reading, seen, previous))
        return self._thread.submit(lambda: self._predict(*self._history.read(), previous))

    def ticked(self) -> None:
        if not self._history.due():
            return
        if self._robot.lockstep:
            self._history.sample()
        elif self._thread.idle_within(0.0):
            # What goes wrong is raised by the next question's own reading.
            self._thread.submit(self._history.sample)

    def accepted(self, answer: Answer) -> None:
        assert isinstance(answer, PolicyAnswer)
        now = self._robot.clock.now()
        self._emit(ChunkAccepted(now, answer.reading, answer.checked(), answer.stages))

    def refused(self, answer: Answer) -> None:
        assert isinstance(answer, PolicyAnswer)
        self._emit(Refused(self._robot.clock.now(), "chunk", {"answer": answer.chunk}))

    def slowest_since(self, since: float) -> tuple[DelaySource, float]:
        return self._robot.delays.longest(since)

    def _predict(
        self, reading: RobotReading, seen: Observation, previous: PreviousChunk | None
    ) -> Answer:
        """The policy's answer to a reading, its chunk checked; in the policy's thread."""
        policy: Any = self._policy
        rest = None if previous is None else previous.continuation(reading.at, policy.horizon)
        began = time.perf_counter()
        try:
            with self._robot.delays.of(POLICY):
                if rest is None:
                    chunk = policy.predict_action(seen)
                else:
                    chunk = policy.continue_action(seen, rest)
        except FluxError:
            raise
        except (Exception, SystemExit) as error:
            if isinstance(error, MemoryError):
                # What the policy computed with is given back: the record needs some of it.
                traceback.clear_frames(error.__traceback__)
            raise PolicyFailed(f"the policy raised {type(error).__name__}: {error}") from error
        stages = {"policy": time.perf_counter() - began, **policy.stages}
        # Checked in this thread: for arrays of a chunk's size numpy releases the GIL, and the
        # thread that sends would have to get it again.
        try:
            actions = self._checked(chunk)
        except BadChunk as error:
            return PolicyAnswer(reading.at, None, error, reading, chunk, stages)
        return PolicyAnswer(reading.at, actions, None, reading, chunk, stages)

    def _checked(self, chunk: Any) -> Array:
        """``(T, D)`` the actions of a chunk, read-only.

        Raises:
            BadChunk: it is no motion for the robot, or not as long as the policy says.
        """
        policy, embodiment = self._policy, self._robot.embodiment
        actions = check_chunk(chunk, embodiment, policy.action_rate_hz, self._safety).copy()
        if len(actions) != policy.horizon:
            raise BadChunk(
                f"the policy's chunk has {len(actions)} actions; it said {policy.horizon}"
            )
        actions.flags.writeable = False
        return actions


class ObservationReader:
    """Reads what a policy is asked with, and lets nothing through that a policy must not act on.

    Args:
        robot: the connected robot.
        observe: makes an observation of the robot's newest frame.
        instruction: the task in words.
        cameras: names of the cameras that the policy looks at.
        safety: how old readings may be, and how far their streams may be apart.
        ready_s: how long the robot may take to give its first reading.
        tracking: the episode's watch; compares each reading with the robot's commands.
        thread: the thread in which the robot is read: cameras may be bound to one.
        interrupts: signals; checked while waiting.
        emit: takes the events ``Observed`` and ``Refused``.
    """

    def __init__(
        self,
        robot: Robot,
        observe: Observe,
        instruction: str,
        cameras: tuple[str, ...],
        safety: SafetySettings,
        ready_s: float,
        tracking: TrackingWatch,
        thread: PolicyThread,
        interrupts: Interrupts,
        emit: Callable[[Event], None],
    ) -> None:
        self._robot = robot
        self._observe = observe
        self._instruction = instruction
        self._cameras = cameras
        self._ready_s = ready_s
        self._tracking = tracking
        self._thread = thread
        self._interrupts = interrupts
        self._emit = emit
        self._gate = FreshnessGate(safety.max_age_s, safety.max_skew_s)

    def first(self) -> RobotReading:
        """The first one, for which the robot has ``ready_s``.

        Raises:
            NotReady: it gave none that is complete and fresh.
            BadFrame: it is not what the embodiment describes.
            Interrupted: a signal came meanwhile.
        """
        until = time.monotonic() + self._ready_s
        while True:
            self._interrupts.check()
            try:
                reading = self._checked(*self._first_frame(until), {})
                break
            except (NotReady, BadTiming) as error:
                if time.monotonic() > until:
                    raise NotReady(
                        f"the robot gave no complete reading within {self._ready_s:g} s: "
                        f"{error.what}",
                        cause=error.cause,
                        next=error.next,
                    ) from error
                time.sleep(0.02)
        self._emit(Observed(self._robot.clock.now(), reading))
        return reading

    def read(self) -> RobotReading:
        """One more; in the thread that asks the policy.

        Raises:
            BadFrame: it is not what the embodiment describes, or a stream is gone.
            BadTiming: it is too old, its streams are too far apart, or one ran backwards.
            NotFollowing: the arm is not where it is commanded to be.
        """
        reading = self._read()
        if self._robot.follows_commands:
            self._tracking.check(reading.state, reading.measured)
        self._emit(Observed(self._robot.clock.now(), reading))
        return reading

    def sample(self) -> RobotReading:
        """One between two questions, for a policy's history; checked as ``read`` checks it, but
        for the arm. The history says whether a question needed it (``Remembered``)."""
        return self._read()

    def _read(self) -> RobotReading:
        began = time.perf_counter()
        observation, frame = self._frame()
        seconds = {"sync": time.perf_counter() - began}
        try:
            return self._checked(observation, frame, seconds)
        except NotReady as error:
            raise BadFrame(error.what, cause="a stream that was there is gone") from error
        except BadTiming as error:
            if frame is not None and seconds["sync"] > _LONG_S:
                last = max(frame.stamps, key=frame.stamps.__getitem__)
                error.cause = (
                    f"{self._robot.frame_call.name} took {seconds['sync']:.2f} s; "
                    f"{last} came last in it"
                )
            raise

    def _first_frame(self, until: float) -> tuple[dict[str, Any], Frame | None]:
        if self._robot.lockstep:
            return self._frame()
        # One that is begun shortly before the end is given its time, too.
        until = max(until, time.monotonic() + _READ_TIMEOUT_S)
        future = self._thread.submit(self._frame)
        while not future.done() and time.monotonic() < until:
            self._interrupts.check()
            wait((future,), timeout=0.02)
        if not future.done():
            raise NotReady(f"{self._robot.name}.get_frame does not return")
        return future.result()

    def _frame(self) -> tuple[dict[str, Any], Frame | None]:
        """The runner's observation of the robot's newest frame.

        Raises:
            BadFrame: it is no observation, or something was raised that is no error of a robot's.
        """
        robot = self._robot
        try:
            with robot.delays.of(robot.frame_call):
                observation, frame = self._observe()
        except FluxError:
            raise
        except (Exception, SystemExit) as error:
            raise BadFrame(
                f"{robot.frame_call.name}, or what the runner makes of it, "
                f"raised {type(error).__name__}: {error}"
            ) from error
        if not isinstance(observation, Mapping) or not isinstance(
            observation.get("images"), Mapping
        ):
            raise BadFrame(
                f"the runner's update_observation_window() gave {_shown(observation)}; "
                "an observation has qpos and a dict of images"
            )
        return observation, frame

    def _checked(
        self, observation: dict[str, Any], frame: Frame | None, seconds: dict[str, float]
    ) -> RobotReading:
        _check_complete(observation, self._cameras)
        measured = at = now = self._robot.clock.now()
        state, images, stamps = observation["qpos"], observation["images"], dict[str, float]()
        if frame is not None:
            age = max(self._gate.check(frame.stamps, self._cameras, now), 0.0)
            state, stamps = frame.state, dict(frame.stamps)
            measured, at = stamps[STATE], now - age
            seconds = {"receipt": age, **seconds}
        seen = Frame(state=state, images=images, stamps=stamps)
        try:
            check_frame(seen, self._robot.embodiment, self._cameras)
        except BadFrame:
            values = {"state": state, "images": images}
            self._emit(Refused(self._robot.clock.now(), "reading", values))
            raise
        state = np.asarray(state, dtype=np.float64)
        asked = {**observation, "task_description": self._instruction}
        return RobotReading(asked, frame, state, measured, at, seconds)


def _shown(window: object) -> str:
    return f"the keys {sorted(map(str, window))}" if isinstance(window, Mapping) else repr(window)


def _check_complete(window: dict[str, Any], cameras: Sequence[str]) -> None:
    """Refuse an observation in which something has not arrived yet.

    Operators written for upstream FluxVLA give None for it.

    Raises:
        NotReady: the state or a camera is missing.
    """
    if _is_nothing(window.get("qpos")):
        raise NotReady("there are no joint states yet")
    missing = [name for name in cameras if window["images"].get(name) is None]
    if missing:
        raise NotReady(f"there is no image of {', '.join(missing)} yet")


def _is_nothing(state: Any) -> bool:
    """Whether there is no state: None, or the one NaN that ``np.array(None, dtype=float)`` is."""
    if isinstance(state, np.ndarray) and state.ndim == 0 and state.dtype.kind == "f":
        return bool(np.isnan(state))
    return state is None


class FreshnessGate:
    """Checks receipt age and skew of an observation's streams, and that none runs backwards.

    Args:
        max_age_s: how old the newest reading of any stream may be.
        max_skew_s: how far the streams may be apart.
    """

    def __init__(self, max_age_s: float, max_skew_s: float) -> None:
        self.max_age_s = max_age_s
        self.max_skew_s = max_skew_s
        self._newest: dict[str, float] = {}

    def check(self, stamps: Mapping[str, float], cameras: Iterable[str], now: float) -> float:
        """Admit one observation.

        Args:
            stamps: stream -> receipt time, on the clock of ``now``.
            cameras: the streams that are needed besides the state.
            now: the current time in seconds.

        Returns:
            The age of its oldest stream, in seconds.

        Raises:
            BadTiming: a stamp is missing, not finite, too old, in the future, older than the one
                before it, or too far from the others.
        """
        ages: dict[str, float] = {}
        for stream in (STATE, *cameras):
            stamp = stamps.get(stream)
            if stamp is None or not is_number(stamp) or not math.isfinite(stamp):
                raise BadTiming(f"stream {stream} has no receipt stamp")
            age = now - stamp
            if age < -AHEAD_S:
                raise BadTiming(
                    f"stream {stream} is stamped {-age:.3f} s in the future",
                    cause="stamps must be receipt times on the operator's own clock",
                )
            before = self._newest.get(stream)
            if before is not None and stamp < before:
                raise BadTiming(f"stream {stream} went back in time by {before - stamp:.3f} s")
            if age > self.max_age_s:
                raise BadTiming(
                    f"stream {stream} is stale: its newest reading is {age:.2f} s old, "
                    f"safety.max_age_s is {self.max_age_s:g}",
                    cause="the camera or the driver froze, or the network lost it",
                )
            ages[stream] = age
        oldest, newest = max(ages, key=ages.__getitem__), min(ages, key=ages.__getitem__)
        skew = ages[oldest] - ages[newest]
        if skew > self.max_skew_s:
            raise BadTiming(
                f"streams {oldest} and {newest} are {skew:.2f} s apart, "
                f"safety.max_skew_s is {self.max_skew_s:g}",
                cause="one of them is delayed or slower than the other",
            )
        self._newest.update({stream: stamps[stream] for stream in ages})
        return ages[oldest]
