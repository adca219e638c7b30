"""``Robot``: an operator with its embodiment and clock; checks everything the operator returns.

Operators written for upstream FluxVLA have ``get_frame`` and commands of their own (``servoj``,
``movegrip``), no embodiment, and open their connection in the constructor. They are accepted when
the config gives the ``embodiment``; the runner's ``_execute_actions`` sends the commands.
"""

from __future__ import annotations

import math
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.check import check_operator, missing_operator_methods
from fluxvla_core.contracts.contract import implements
from fluxvla_core.contracts.frame import Frame
from fluxvla_core.contracts.robot import Operator
from fluxvla_core.control.clock import Rate, clock_of, in_lockstep
from fluxvla_core.control.delays import DelayMonitor, robot_call
from fluxvla_core.control.safety import BadFrame
from fluxvla_core.errors import ConfigError, Faulted, FluxError, LoadFailed, SpecMismatch
from fluxvla_core.spec import NO_SPEEDS, EmbodimentSpec, check_match, speeds

# How long a safe stop may take before the message says to use the emergency stop.
STOP_S = 5.0
_LEAST_SPEED = 0.01


Observe = Callable[[], tuple[dict[str, Any], Frame | None]]
"""Makes an observation of the robot's newest frame, and returns the frame as well if it has it:
a runner's ``update_observation_window``."""


@dataclass(frozen=True)
class StateSample:
    """A ``(state_dim,)`` state and when it arrived (seconds on the robot's clock)."""

    state: npt.NDArray[np.float64]
    at: float


class Robot:
    """An operator, its embodiment and its clock.

    Args:
        operator: an object; not connected yet if it has ``connect``.
        embodiment: what the config says about it; None when it has its own.
        runner_sends: whether the runner has an ``_execute_actions`` of its own, and so needs no
            ``send_action``.
        kind: the class of an operator in another process that ``operator`` stands in for.

    Raises:
        LoadFailed: the operator lacks something that nothing makes up for.
        SpecMismatch: the config's embodiment and the operator's own differ, or a joint is a speed.
    """

    def __init__(
        self,
        operator: Any,
        embodiment: EmbodimentSpec | Mapping[str, Any] | None = None,
        runner_sends: bool = False,
        kind: type | None = None,
    ) -> None:
        self._operator = Operator.adapt(operator)
        self._described: Any = self._operator if kind is None else kind
        self.name = (kind or type(operator)).__name__
        check_operator(operator)
        self.embodiment = self._embodiment(embodiment)
        moving = speeds(self.embodiment)
        if moving:
            raise SpecMismatch(
                f"{self.embodiment.name} has joints that are speeds by their names: "
                f"{', '.join(moving)}; {NO_SPEEDS}",
                next="describe them with Joint.base(name, unit, speed, acceleration), or leave "
                "them out and drive the base by a method of the operator's own, as "
                "AlohaOperator.drive does; a joint that is commanded by its position needs "
                "another name",
            )
        lacks = missing_operator_methods(operator)
        self.complete = not lacks
        if not runner_sends and "send_action()" in lacks:
            raise LoadFailed(
                f"{self.name} has no send_action(); no command could be sent to it",
                next="see docs/writing-a-plugin.md for what an operator has, or give the runner "
                "an _execute_actions of its own",
            )
        self.sent_s: float | None = None
        self._reads_state, self._stamps_state = self._has("get_state"), self._has("state_stamp")
        # A replayed robot ignores commands, so tracking is not checked.
        self.follows_commands = bool(self._operator.follows_commands)
        self.clock = clock_of(self._operator)
        self.lockstep = in_lockstep(self.clock)
        self.delays = DelayMonitor()
        self.frame_call = robot_call(f"{self.name}.get_frame()")
        self._sending = robot_call(f"{self.name}.send_action()")
        self._measuring = robot_call(f"{self.name}.get_state()")

    def connect(self) -> None:
        """Open the connection, where there is a ``connect``; the constructor did it otherwise.

        Raises:
            OperatorError: what the operator raised.
        """
        self._call("connect", self._operator.connect)

    def send_action(self, action: npt.NDArray[np.float64]) -> None:
        """Send one ``(D,)`` command; ``sent_s`` is how long the last one took.

        Raises:
            OperatorError: what the operator raised; anything that is none becomes ``Faulted``.
        """
        began = time.perf_counter()
        with self.delays.of(self._sending):
            self._call("send_action", self._operator.send_action, action)
        self.sent_s = time.perf_counter() - began

    def send_actions(self, actions: npt.NDArray[np.float64], rate: Rate) -> None:
        """Send ``(N, D)`` commands, one at each tick of ``rate``.

        Raises:
            OperatorError: as :meth:`send_action`.
        """
        for action in actions:
            rate.wait()
            self.send_action(action)
            rate.sleep()

    def frame(self) -> Frame:
        """The newest frame of an operator that has frames.

        Raises:
            BadFrame: it is none, or something was raised that is no error of a robot's.
            OperatorError: what the operator raised.
        """
        return as_frame(self._ask("get_frame", self._operator.get_frame), self.frame_call.name)

    def state(self) -> StateSample | None:
        """The state alone, from an operator that has ``get_state``; else None.

        It is read after each command, on a real robot while another thread may read frames.

        Raises:
            BadFrame: it is not what the embodiment describes, or its stamp is none; or something
                was raised that is no error of a robot's.
            OperatorError: what the operator raised.
        """
        if not self._reads_state:
            return None
        at = None
        with self.delays.of(self._measuring):
            if self._stamps_state:
                # Before the state: what arrives in between is newer than it says, which does no
                # harm.
                stamp = self._ask("state_stamp", self._operator.state_stamp)
                at = as_number(stamp, f"{self.name}.state_stamp()")
            found = self._ask("get_state", self._operator.get_state)
            state = as_state(found, self.embodiment, self._measuring.name)
        return StateSample(state, self.clock.now() if at is None else at)

    @property
    def speed(self) -> Callable[[], float] | None:
        """The share of its speed that a person allows (``speed_scaling``), or None."""
        operator = self._operator
        if not self._has("speed_scaling"):
            return None
        # An arm that is paused takes no command, and says so when it is given one.
        name = f"{self.name}.speed_scaling"
        return lambda: min(max(as_number(operator.speed_scaling, name), _LEAST_SPEED), 1.0)

    def commanded(self, before: npt.NDArray[np.float64] | None) -> npt.NDArray[np.float64] | None:
        """``(D,)`` the arm's last command, None if nothing, or nothing that still counts.

        Args:
            before: the last command of this run, for operators without ``last_action``.
        """
        if self._has("last_action"):
            last = self._operator.last_action
            name = f"{self.name}.last_action"
            names = self.embodiment.joint_names
            return None if last is None else _as_vector(last, names, self.embodiment.name, name)
        # Who begins episodes may put the arm elsewhere.
        return None if self._has("begin_episode") else before

    @property
    def images_after(self) -> Callable[..., Any] | None:
        """The operator's ``images_after``, which gives images that it kept, or None."""
        if self._has("images_after"):
            return self._operator.images_after
        if self._has("pictures_after"):
            operator: Any = self._operator
            message = f"{self.name}.pictures_after is deprecated, name it images_after"
            warnings.warn(message, DeprecationWarning, stacklevel=2)
            found: Callable[..., Any] = operator.pictures_after
            return found
        return None

    @property
    def simulated(self) -> bool:
        """Whether the operator puts the scene in place itself (``begin_episode``)."""
        return implements(self._described, Operator, "begin_episode")

    @property
    def reports_last_action(self) -> bool:
        """Whether ``commanded`` holds after a stop too: without ``last_action`` an operator's own
        ``stop`` may have commanded anything."""
        return self._has("last_action") or not self.can_stop

    def success(self) -> bool | None:
        """Whether the task is done as of now (``task_success``); None where that is not known."""
        found = self._operator.task_success()
        return None if found is None else bool(found)

    def facts(self) -> Mapping[str, Any]:
        """Facts about the last episode from the operator (``episode_facts``)."""
        return self._operator.episode_facts()

    def done(self) -> bool:
        """Whether the operator says that the episode is over (``task_done``).

        Raises:
            BadFrame: it says something else, or raises.
        """
        found = self._ask("task_done", self._operator.task_done)
        if not isinstance(found, (bool, np.bool_)):
            raise BadFrame(f"{self.name}.task_done() gave {found!r}, neither True nor False")
        return bool(found)

    def begin(self, instruction: str, episode: int) -> None:
        """Begin an episode (``begin_episode``): simulations put their objects in place.

        ``episode`` counts from 0.
        """
        self._call("begin_episode", self._operator.begin_episode, instruction, episode)

    @property
    def can_stop(self) -> bool:
        """Whether the operator itself knows how to stop.

        Only an operator whose runner sends the commands may lack ``stop``: it is stopped by
        commands that brake, and held by the last of them.
        """
        return implements(self._described, Operator, "stop")

    def stop(self) -> str | None:
        """Bring the robot to a safe stop; None, or what went wrong. Never raises, never hangs."""
        return self._bounded("stop", self._operator.stop) if self.can_stop else None

    def close(self) -> str | None:
        """Close the connection; returns None, or what went wrong. Never raises, never hangs."""
        return self._bounded("close", self._operator.close) if self._has("close") else None

    def _has(self, ability: str) -> bool:
        return implements(self._operator, Operator, ability)

    def _ask(self, method: str, function: Callable[[], object]) -> Any:
        """The result of a getter of the operator's; if it fails, commands can still be sent."""
        try:
            return function()
        except FluxError:
            raise
        except (Exception, SystemExit) as error:
            raise BadFrame(
                f"{self.name}.{method}() raised {type(error).__name__}: {error}"
            ) from error

    def _call(self, method: str, function: Callable[..., object], *arguments: Any) -> None:
        try:
            function(*arguments)
        except FluxError:
            raise
        except (Exception, SystemExit) as error:
            raise Faulted(f"{self.name}.{method} raised {type(error).__name__}: {error}") from error

    def _bounded(self, method: str, function: Callable[[], object]) -> str | None:
        if self.lockstep:
            # Simulations are bound to one thread (renderers are), and cannot hurt anybody.
            return self._reported(method, function)

        found: list[str | None] = []

        def call() -> None:
            found.append(self._reported(method, function))

        thread = threading.Thread(target=call, name=f"fluxvla-{method}", daemon=True)
        thread.start()
        thread.join(STOP_S)
        if thread.is_alive():
            return (
                f"{self.name}.{method} did not return within {STOP_S:g} s: "
                "use the robot's emergency stop"
            )
        return found[0] if found else None

    def _reported(self, method: str, function: Callable[[], object]) -> str | None:
        try:
            function()
        except (Exception, SystemExit) as error:  # noqa: BLE001 - reported; the rest of the stop follows
            return f"{self.name}.{method} raised {type(error).__name__}: {error}"
        return None

    def _embodiment(self, configured: EmbodimentSpec | Mapping[str, Any] | None) -> EmbodimentSpec:
        if configured is not None and not isinstance(configured, (EmbodimentSpec, Mapping)):
            raise ConfigError(f"embodiment must be a table, got {configured!r}")
        spec = (
            EmbodimentSpec.from_dict(configured) if isinstance(configured, Mapping) else configured
        )
        own: Any = self._operator.embodiment if self._has("embodiment") else None
        if own is None and spec is None:
            raise LoadFailed(
                f"{self.name} has no embodiment: which joints it moves and within which limits is "
                "not known, so nothing may be sent to it",
                cause="the operator was written for upstream FluxVLA, where operators have none",
                next="give the section embodiment = dict(name=…, joints=[…], cameras=[…], "
                "rate_hz=…), or the operator an attribute embodiment",
            )
        if own is None:
            assert spec is not None
            return spec
        if not isinstance(own, EmbodimentSpec):
            raise LoadFailed(
                f"{self.name}.embodiment is a {type(own).__name__}, not an EmbodimentSpec"
            )
        if spec is not None:
            check_match(spec, own, "the config's embodiment", self.name)
            _check_tighter(spec, own)
            return spec
        return own


def _check_tighter(config: EmbodimentSpec, operator: EmbodimentSpec) -> None:
    """A config may narrow a robot's limits; it cannot widen them."""
    for config_joint, operator_joint in zip(config.joints, operator.joints, strict=True):
        limits = {
            "lower": (config_joint.lower, operator_joint.lower),
            "upper": (config_joint.upper, operator_joint.upper),
            "velocity": (config_joint.velocity, operator_joint.velocity),
            "acceleration": (config_joint.acceleration, operator_joint.acceleration),
            "jerk": (config_joint.jerk or math.inf, operator_joint.jerk or math.inf),
        }
        for name, (value, own_limit) in limits.items():
            if (value < own_limit) if name == "lower" else (value > own_limit):
                raise SpecMismatch(
                    f"the config's embodiment widens {name} of {config_joint.name} to {value:g}; "
                    f"the robot's own limit is {own_limit:g}"
                )


def as_frame(value: Any, source: str) -> Frame:
    """``value``, checked to have the fields of a ``Frame``.

    Args:
        value: what ``source`` gave, for example ``Arm.get_frame()``.

    Raises:
        BadFrame: it is something else; names ``source``.
    """
    fields = ("state", "images", "stamps")
    if not all(hasattr(value, field) for field in fields):
        raise BadFrame(
            f"{source} gave a {type(value).__name__}, not a Frame",
            cause="a Frame has state, images and stamps; where there is no frame yet, "
            "get_frame() raises NotReady",
            next="see docs/writing-a-plugin.md for an example",
        )
    for field in fields[1:]:
        found = getattr(value, field)
        if not isinstance(found, Mapping):
            raise BadFrame(f"{field} of what {source} gave is a {type(found).__name__}, not a dict")
    frame: Frame = value
    return frame


def as_state(value: Any, embodiment: EmbodimentSpec, source: str) -> npt.NDArray[np.float64]:
    """``value`` as a checked ``(state_dim,)`` float64 array; ``source`` is for the message.

    Raises:
        BadFrame: it is no array of numbers, has another shape, or is not finite.
    """
    return _as_vector(value, embodiment.state_names, embodiment.name, source)


def _as_vector(
    value: Any, names: tuple[str, ...], robot: str, source: str
) -> npt.NDArray[np.float64]:
    try:
        vector = np.asarray(value)
    except ValueError:  # rows of different lengths
        vector = np.empty(0, dtype=object)
    if vector.dtype.kind not in "fiu":
        raise BadFrame(f"{source} is no array of numbers, but a {type(value).__name__}")
    if vector.shape != (len(names),):
        raise BadFrame(f"{source} has shape {vector.shape}; {robot} has ({len(names)},)")
    bad = [name for name, ok in zip(names, np.isfinite(vector), strict=True) if not ok]
    if bad:
        raise BadFrame(f"{source} is not finite for {', '.join(bad)}")
    return vector.astype(np.float64)


def as_number(value: Any, source: str) -> float:
    """``value`` as a float, checked to be finite; ``source`` is for the message.

    Raises:
        BadFrame: it is none.
    """
    if not is_number(value) or not math.isfinite(value):
        raise BadFrame(f"{source} is {value!r}, not a finite number")
    return float(value)


def is_number(value: Any) -> bool:
    """Whether ``value`` is a real number, of Python or numpy, and not a bool."""
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)


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
