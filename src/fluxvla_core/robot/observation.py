"""Observations of a robot for its policy: complete, fresh, and as the embodiment describes."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import wait
from typing import Any

import numpy as np

from fluxvla_core.build import RunContext
from fluxvla_core.contracts.frame import STATE, Frame
from fluxvla_core.contracts.policy import Policy
from fluxvla_core.errors import FluxError, NotReady, SpecMismatch
from fluxvla_core.robot.control.interrupt import Interrupts
from fluxvla_core.robot.control.safety import BadFrame, BadTiming, SafetySettings
from fluxvla_core.robot.control.tracking import TrackingWatch
from fluxvla_core.robot.events import Event, Observed, Refused, RobotReading
from fluxvla_core.robot.policy_thread import PolicyThread
from fluxvla_core.robot.robot import Robot, as_state, is_number
from fluxvla_core.spec.embodiment import EmbodimentSpec, check_match

_READ_TIMEOUT_S = 0.5  # the least time that the first reading is given
_LONG_S = 0.1  # a reading that takes longer makes its own streams old

# A stamp may be this far in the future: the reading was taken while its age was computed.
AHEAD_S = 0.005

Observe = Callable[[], tuple[dict[str, Any], Frame | None]]
"""Makes an observation of the robot's newest frame; returns the frame as well if it has it."""


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
        for the arm, and no event."""
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
                    f"{self._robot.reading.name} took {seconds['sync']:.2f} s; "
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
            with robot.delays.of(robot.reading):
                observation, frame = self._observe()
        except FluxError:
            raise
        except (Exception, SystemExit) as error:
            raise BadFrame(
                f"{robot.reading.name}, or what the runner makes of it, "
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


def check_frame(frame: Frame, embodiment: EmbodimentSpec, cameras: Iterable[str]) -> None:
    """Refuse a frame that is not what the embodiment describes.

    Args:
        frame: as ``Operator.get_frame`` returns it.
        embodiment: whose state and cameras are expected.
        cameras: names of the cameras that are needed.

    Raises:
        BadFrame: state of another shape or not finite; a camera missing; an image that is not
            ``(height, width, 3)`` uint8 of the camera's size.
    """
    as_state(frame.state, embodiment, "the robot's state")
    sizes = {camera.name: (camera.height, camera.width, 3) for camera in embodiment.cameras}
    for name in cameras:
        image = frame.images.get(name)
        if image is None:
            raise BadFrame(
                f"camera {name} gave no image", cause="it is not connected, or has another name"
            )
        if not isinstance(image, np.ndarray):
            raise BadFrame(f"camera {name} gives a {type(image).__name__}, not an array")
        if image.dtype != np.uint8 or image.shape != sizes.get(name, image.shape):
            raise BadFrame(
                f"camera {name} gives {image.shape} {image.dtype}, "
                f"the embodiment says {sizes.get(name)} uint8",
                cause="the camera's mode was changed, or the spec is of another camera",
            )


def fit_cameras(
    policy: Policy,
    embodiment: EmbodimentSpec,
    chosen: tuple[str, ...] | None,
    context: RunContext,
) -> tuple[str, ...]:
    """Check that a policy is for a robot; the names of the cameras to observe.

    Args:
        policy: loaded.
        embodiment: the robot's.
        chosen: the config's ``camera_names``; None for those that the policy looks at.
        context: of the run; its reporter warns of images that are scaled.

    Raises:
        SpecMismatch: the policy is for another robot, or for other views.
        ConfigError: ``camera_names`` does not fit.
    """
    looks_at = tuple(policy.cameras)
    cameras = chosen or looks_at
    check_match(policy.embodiment, embodiment, "the policy", "the robot", looks_at)
    known = embodiment.camera_names
    for name in (*cameras, *looks_at):
        if name not in known:
            raise context.error(
                "camera_names", f"{name!r} is unknown; choose one of {', '.join(known)}"
            )
        if name not in cameras:
            raise context.error("camera_names", f"the policy looks at {name!r} too")
    for warning in scaled_views(policy.embodiment, embodiment, looks_at):
        context.reporter.warn(warning)
    return cameras


def scaled_views(trained: EmbodimentSpec, here: EmbodimentSpec, names: Sequence[str]) -> list[str]:
    """Check that a robot's cameras show what the policy was trained on, perhaps larger.

    A camera may have more pixels than in training; it may not show another view.

    Args:
        trained, here: the embodiments of the policy and of the robot.
        names: the cameras that the policy looks at.

    Returns:
        What is to be said of images that are scaled.

    Raises:
        SpecMismatch: a camera's images have another aspect.
    """
    cameras = {camera.name: camera for camera in here.cameras}
    said = []
    for then in trained.cameras:
        now = cameras.get(then.name)
        if then.name not in names or now is None:
            continue
        if (now.height, now.width) == (then.height, then.width):
            continue
        sizes = (
            f"camera {then.name} gives {now.height} x {now.width} images; the policy was "
            f"trained on {then.height} x {then.width}"
        )
        difference = abs(now.width * then.height - then.width * now.height)
        if difference > 0.01 * now.height * then.width:
            raise SpecMismatch(
                f"{sizes}: another view",
                next="set the camera to the size, or at least the aspect, of the recordings",
            )
        said.append(f"{sizes}; they are scaled")
    return said
