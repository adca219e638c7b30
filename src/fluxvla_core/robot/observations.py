"""Observations in an episode: reading the robot, checking age and content, keeping a history.

How old an observation may be for the policy (``safety.max_age_s``) is checked by
``FreshnessGate``, for every kind of operator. The history is for policies that act on several
observations, one action apart (``n_obs_steps``).
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass
from typing import Any

import numpy as np

from fluxvla_core.contracts.frame import STATE, Frame, Observation
from fluxvla_core.contracts.policy import Policy, with_history
from fluxvla_core.control.interrupt import Interrupts
from fluxvla_core.control.safety import BadFrame, BadTiming, SafetySettings
from fluxvla_core.control.tracking import TrackingWatch
from fluxvla_core.errors import FluxError, NotReady
from fluxvla_core.robot.events import Event, HistoryObserved, Observed, ObservedFrame, Refused
from fluxvla_core.robot.robot import Observe, Robot, check_frame, is_number

_READ_TIMEOUT_S = 0.5  # the least time that the first frame is given
_LONG_S = 0.1  # a frame that takes longer makes its own streams old
_AHEAD_S = 0.005  # a stamp may be this far in the future: its age was computed meanwhile
# Times of a history's observations, in actions.
_AWAY = 0.6  # half of one, where the robot is read once an action, and what threads add
_EARLY = 0.1  # ticks come a little early or late
_ROUNDING_S = 1e-6  # of sums of a clock's steps


@dataclass(eq=False)
class ObservationReader:
    """Reads the robot for the policy; raises an error for what a policy must not act on.

    Args:
        robot: the connected robot.
        observe: makes an observation of the robot's newest frame.
        instruction: the task in words.
        cameras: names of the cameras that the policy looks at.
        safety: how old observations may be, and how far their streams may be apart.
        ready_s: how long the robot may take to give its first frame.
        tracking: the episode's watch; compares each state with the robot's commands.
        submit: runs a function in the thread in which the robot is read: cameras may be bound to
            one.
        interrupts: signals; checked while waiting.
        emit: takes the events ``Observed`` and ``Refused``.
    """

    robot: Robot
    observe: Observe
    instruction: str
    cameras: tuple[str, ...]
    safety: SafetySettings
    ready_s: float
    tracking: TrackingWatch
    submit: Callable[[Observe], Future[tuple[dict[str, Any], Frame | None]]]
    interrupts: Interrupts
    emit: Callable[[Event], None]

    def __post_init__(self) -> None:
        self._gate = FreshnessGate(self.safety.max_age_s, self.safety.max_skew_s)

    def first(self) -> ObservedFrame:
        """The first one, for which the robot has ``ready_s``.

        Raises:
            NotReady: it gave none that is complete and fresh.
            BadFrame: it is not what the embodiment describes.
            Interrupted: a signal came meanwhile.
        """
        until = time.monotonic() + self.ready_s
        while True:
            self.interrupts.check()
            try:
                observed = self._checked(*self._first_frame(until), {})
                break
            except (NotReady, BadTiming) as error:
                if time.monotonic() > until:
                    raise NotReady(
                        f"the robot gave no complete frame within {self.ready_s:g} s: {error.what}",
                        cause=error.cause,
                        next=error.next,
                    ) from error
                time.sleep(0.02)
        self.emit(Observed(self.robot.clock.now(), observed))
        return observed

    def read(self) -> ObservedFrame:
        """The next one; in the thread that queries the policy.

        Raises:
            BadFrame: it is not what the embodiment describes, or a stream is gone.
            BadTiming: it is too old, its streams are too far apart, or one ran backwards.
            NotFollowing: the arm is not where it is commanded to be.
        """
        observed = self.sample()
        if self.robot.follows_commands:
            self.tracking.check(observed.state, observed.measured)
        self.emit(Observed(self.robot.clock.now(), observed))
        return observed

    def sample(self) -> ObservedFrame:
        """An observation between two queries, for a policy's history; the arm is not checked.

        The history emits it, if a query needs it (``HistoryObserved``).
        """
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
                    f"{self.robot.frame_call.name} took {seconds['sync']:.2f} s; "
                    f"{last} came last in it"
                )
            raise

    def _first_frame(self, until: float) -> tuple[dict[str, Any], Frame | None]:
        if self.robot.lockstep:
            return self._frame()
        # One that is begun shortly before the end is given its time, too.
        until = max(until, time.monotonic() + _READ_TIMEOUT_S)
        future = self.submit(self._frame)
        while not future.done() and time.monotonic() < until:
            self.interrupts.check()
            wait((future,), timeout=0.02)
        if not future.done():
            raise NotReady(f"{self.robot.name}.get_frame does not return")
        return future.result()

    def _frame(self) -> tuple[dict[str, Any], Frame | None]:
        """The runner's observation of the robot's newest frame.

        Raises:
            BadFrame: it is no observation, or something was raised that is no error of a robot's.
        """
        robot = self.robot
        try:
            with robot.delays.of(robot.frame_call):
                observation, frame = self.observe()
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
    ) -> ObservedFrame:
        _check_complete(observation, self.cameras)
        measured = at = now = self.robot.clock.now()
        state, images, stamps = observation["qpos"], observation["images"], dict[str, float]()
        if frame is not None:
            age = max(self._gate.check(frame.stamps, self.cameras, now), 0.0)
            state, stamps = frame.state, dict(frame.stamps)
            measured, at = stamps[STATE], now - age
            seconds = {"receipt": age, **seconds}
        seen = Frame(state=state, images=images, stamps=stamps)
        try:
            check_frame(seen, self.robot.embodiment, self.cameras)
        except BadFrame:
            values = {"state": state, "images": images}
            self.emit(Refused(self.robot.clock.now(), "observation", values))
            raise
        state = np.asarray(state, dtype=np.float64)
        asked = {**observation, "task_description": self.instruction}
        return ObservedFrame(asked, frame, state, measured, at, seconds)


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
        max_age_s: ``safety.max_age_s``: how old the newest data of any stream may be.
        max_skew_s: ``safety.max_skew_s``: how far the receipt times may be apart.
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
            if age < -_AHEAD_S:
                raise BadTiming(
                    f"stream {stream} is stamped {-age:.3f} s in the future",
                    cause="stamps must be receipt times on the operator's own clock",
                )
            before = self._newest.get(stream)
            if before is not None and stamp < before:
                raise BadTiming(f"stream {stream} went back in time by {before - stamp:.3f} s")
            if age > self.max_age_s:
                raise BadTiming(
                    f"stream {stream} is stale: its newest data is {age:.2f} s old, "
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


@dataclass
class _Kept:
    """An observation that was begun ``at`` and done at ``made``, and whether it is an event yet."""

    at: float
    made: float
    observed: ObservedFrame
    emitted: bool

    @property
    def observation(self) -> Observation:
        seen: Observation = {**self.observed.observation}  # type: ignore[typeddict-item]
        return seen


class ObservationHistory:
    """Earlier observations for a policy that acts on several (``n_obs_steps``), in one episode.

    The policy takes them one action apart, and is queried less often. So the robot is also read
    between two queries, at the rate of the actions, by the policy's thread. During inference that
    thread cannot read the robot; if an observation is missing after it, the query waits until as
    many were made as the policy takes, one for each action.

    An observation of the history is the one that was made nearest to its time, at most 0.6 of an
    action away; in a lockstep simulation whose actions are whole control steps it is that of its
    time. All methods but ``due`` are called in the thread that reads the robot.

    Args:
        reader: reads the robot, for a query and between two.
        policy: has the number of observations, and the rate of its actions.
        sleep: waits so many seconds.
    """

    def __init__(
        self,
        reader: ObservationReader,
        policy: Policy,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.steps = policy.n_obs_steps
        self._reader, self._robot, self._sleep = reader, reader.robot, sleep
        self._apart = 1.0 / policy.action_rate_hz
        self._kept: deque[_Kept] = deque()
        self._first = 0.0
        self._next: float | None = None

    def reset(self) -> None:
        """Begin an episode."""
        self._kept.clear()
        self._next = None

    def due(self) -> bool:
        """Whether the robot is to be read for the history, now that nobody asks."""
        if self.steps == 1 or self._next is None:
            return False
        now, apart = self._robot.clock.now(), self._apart
        if now < self._next - _EARLY * apart:
            return False
        self._next = max(self._next + apart, now + apart / 2)
        return True

    def sample(self) -> None:
        """Read the robot for the history.

        Raises:
            BadFrame, BadTiming: as ``ObservationReader.read``.
        """
        at = self._robot.clock.now()
        self._keep(at, self._reader.sample(), emitted=False)

    def read(self) -> tuple[ObservedFrame, Observation]:
        """An observation of the robot, and the policy's input: the same with the history.

        Raises:
            BadFrame, BadTiming, NotFollowing: as ``ObservationReader.read``; or the robot cannot
                be read as often as the policy needs it.
        """
        began = self._robot.clock.now()
        while True:
            at = self._robot.clock.now()
            observed = self._reader.read()
            present: Observation = {**observed.observation}  # type: ignore[typeddict-item]
            if self.steps == 1:
                return observed, present
            before = self._before(at)
            self._keep(at, observed, emitted=True)
            if before is not None:
                for each in before:
                    if not each.emitted:
                        each.emitted = True
                        self._reader.emit(HistoryObserved(each.made, each.observed))
                seen = [each.observation for each in before]
                return observed, with_history(present, self.steps, seen)
            now = self._robot.clock.now()
            patience_s = self._reader.safety.max_age_s + self.steps * self._apart
            if self._robot.lockstep or now - began > patience_s:
                raise BadTiming(
                    f"the policy acts on {self.steps} observations {self._apart:.3g} s apart "
                    f"(n_obs_steps), and the robot was not read that often: "
                    f"{self._robot.frame_call.name} took {now - at:.2f} s",
                    cause="the cameras or this machine are too slow for the policy's action rate",
                )
            self._sleep(max(at + self._apart - now, 0.0))

    def _keep(self, at: float, observed: ObservedFrame, emitted: bool) -> None:
        if not self._kept:
            self._first = at
        self._kept.append(_Kept(at, self._robot.clock.now(), observed, emitted))
        while self._kept[0].at < at - self.steps * self._apart:
            self._kept.popleft()
        if self._next is None or at + self._apart / 2 > self._next:
            self._next = at + self._apart

    def _before(self, at: float) -> list[_Kept] | None:
        """The observations before ``at``; None where one is missing, fewer where the episode began.

        The first of an episode is repeated, by ``with_history``.
        """
        found: list[_Kept] = []
        for back in reversed(range(1, self.steps)):
            wanted = at - back * self._apart
            if not self._kept:
                continue
            if wanted < self._first + _ROUNDING_S:
                found.append(self._kept[0])
                continue
            seen = min(self._kept, key=lambda each: abs(each.at - wanted))
            if abs(seen.at - wanted) > _AWAY * self._apart:
                return None
            found.append(seen)
        return found
