"""Simulated ROS drivers: state messages from a scene's state, joint targets from commands."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from fluxvla_aloha.presets import Preset
from fluxvla_ur.embodiment import JOINTS
from fluxvla_ur.operator import BOOL, CONTROLLERS, TRAJECTORY
from fluxvla_ur.servo import STEP, STREAMED, is_taken

from fluxvla_core.errors import ConfigError
from fluxvla_core.ros2 import (
    FLOAT64,
    JOINT_STATE,
    ODOMETRY,
    TWIST,
    BadMessage,
    joints,
    message_class,
)

Array = npt.NDArray[np.float64]
TIMEOUT_S = 0.5
"""A speed that is not asked for again within this time ends, as real bases have it."""


class Driver(Protocol):
    """Converts between a scene's numbers and a robot's messages; has no publisher and no clock.

    ``states`` and ``latched`` are stream -> (topic, message type), ``cameras`` and ``depths`` are
    the scene's camera -> topic, ``commands`` is topic -> message type. So is ``knobs``, what a
    person sets on the robot, which no driver has a topic for. ``now`` is in simulated seconds.
    """

    states: Mapping[str, tuple[str, str]]
    latched: Mapping[str, tuple[str, str]]
    cameras: Mapping[str, str]
    depths: Mapping[str, str]
    commands: Mapping[str, str]
    knobs: Mapping[str, str]

    def messages(self, state: Array, now: float) -> dict[str, Any]:
        """Stream -> message, of the scene's ``(D,)`` state; ``latched`` ones too."""

    def receive(self, topic: str, message: Any, now: float) -> None:
        """Take a command, or what a knob is set to.

        Raises:
            BadMessage: it is none: names are missing, or numbers are not finite.
        """

    def target(self, now: float) -> Array:
        """``(D,)`` what the arm drives to at ``now``."""

    def reset(self, state: Array) -> None:
        """Forget all commands; the arm stays at ``state``."""


class MobileBase:
    """Takes a ``Twist``, gives its ``Odometry``: a differential drive that has its speed at once.

    The scene does not move: table and objects would have to come along. Only the odometry shows
    where the base is.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Stand still, where odometry begins."""
        self._x = self._y = self._heading = 0.0
        self._forward = self._turning = 0.0
        self._at = self._until = 0.0

    def drive(self, message: Any, topic: str, now: float) -> None:
        """Take a speed.

        Raises:
            BadMessage: it is not finite.
        """
        forward, turning = float(message.linear.x), float(message.angular.z)
        if not (math.isfinite(forward) and math.isfinite(turning)):
            raise BadMessage(f"{topic}: a speed is not finite")
        self._roll(now)
        self._forward, self._turning = forward, turning
        self._until = now + TIMEOUT_S

    def odometry(self, now: float) -> Any:
        """The odometry at ``now``."""
        self._roll(now)
        message = message_class(ODOMETRY)()
        message.header.frame_id, message.child_frame_id = "odom", "base_link"
        pose, twist = message.pose.pose, message.twist.twist
        pose.position.x, pose.position.y = self._x, self._y
        pose.orientation.z = math.sin(self._heading / 2)
        pose.orientation.w = math.cos(self._heading / 2)
        twist.linear.x, twist.angular.z = self._forward, self._turning
        return message

    def _roll(self, now: float) -> None:
        passed = min(now, self._until) - self._at
        if passed > 0:
            # Half of the turn before the way, half after it: exact to the second order.
            self._heading += self._turning * passed / 2
            self._x += self._forward * passed * math.cos(self._heading)
            self._y += self._forward * passed * math.sin(self._heading)
            self._heading += self._turning * passed / 2
        self._at = now
        if now >= self._until:
            self._forward = self._turning = 0.0


class AlohaDriver:
    """Two arms with grippers on a mobile base, as their drivers present them.

    Args:
        preset: topics, names and raw gripper values.
        arm_message, gripper_message: in place of the preset's types (see ``AlohaOperator``).
    """

    _ARM = 7
    _SIDES = ("left", "right")

    def __init__(
        self, preset: Preset, arm_message: str | None = None, gripper_message: str | None = None
    ) -> None:
        self._preset = preset
        names = [f"{side} arm" for side in self._SIDES]
        self._arms = dict(zip(names, preset.states, strict=True))
        self.states = {name: (topic, JOINT_STATE) for name, topic in self._arms.items()}
        self.states["base"] = (preset.odometry, ODOMETRY)
        self.latched: Mapping[str, tuple[str, str]] = {}
        self.knobs: Mapping[str, str] = {}
        scene = ("top", "left_wrist", "right_wrist")
        self.cameras = dict(zip(scene, preset.images, strict=True))
        self.depths = dict(zip(scene, preset.depths, strict=True))
        self._base = MobileBase()
        # Topic -> the columns of the action that it commands.
        self._columns: dict[str, range] = {}
        self.commands: dict[str, str] = {preset.velocity: TWIST}
        for index, topic in enumerate(preset.commands):
            first = self._ARM * index
            length = self._ARM - 1 if preset.gripper_commands else self._ARM
            self._columns[topic] = range(first, first + length)
            self.commands[topic] = arm_message or preset.arm_message
            if preset.gripper_commands:
                gripper = preset.gripper_commands[index]
                self._columns[gripper] = range(first + length, first + length + 1)
                self.commands[gripper] = gripper_message or preset.gripper_message
        self._target: Array = np.zeros(2 * self._ARM)

    def messages(self, state: Array, now: float) -> dict[str, Any]:
        messages = {"base": self._base.odometry(now)}
        for index, name in enumerate(self._arms):
            arm = state[self._ARM * index : self._ARM * (index + 1)].copy()
            arm[-1] = self._raw(arm[-1])
            messages[name] = joints.fill(message_class(JOINT_STATE)(), self._preset.joints, arm)
        return messages

    def receive(self, topic: str, message: Any, now: float) -> None:
        if topic == self._preset.velocity:
            self._base.drive(message, topic, now)
            return
        columns = self._columns[topic]
        names = [self._preset.joints[column % self._ARM] for column in columns]
        values = command_values(message, names, topic)
        for column, value in zip(columns, values, strict=True):
            gripper = column % self._ARM == self._ARM - 1
            self._target[column] = self._opening(value) if gripper else value

    def target(self, now: float) -> Array:
        return self._target

    def reset(self, state: Array) -> None:
        self._target = np.array(state)
        self._base.reset()

    def _raw(self, opening: float) -> float:
        closed, opened = self._preset.gripper_closed, self._preset.gripper_open
        return closed + opening * (opened - closed)

    def _opening(self, raw: float) -> float:
        closed, opened = self._preset.gripper_closed, self._preset.gripper_open
        return (raw - closed) / (opened - closed)


class URDriver:
    """A UR arm as ur_robot_driver presents it, and a gripper that takes and gives a number.

    Like the program on a real robot it ignores streamed positions that are too far away.

    Args:
        controller: the one that is active.
        speed_scaling: the teach pendant's slider in percent, which ``/sim/speed_scaling`` moves.
            The scaled controller slows its trajectories down by it; the others take no notice.

    Raises:
        ConfigError: the slider does not go there.
    """

    _ARM = len(JOINTS)
    _GRIPPER = "/gripper/command"
    _SLIDER = "/sim/speed_scaling"
    _SCALED = "scaled_joint_trajectory_controller"
    # Older drivers sort joints by name: an operator that reads them by index fails here.
    _NAMES = tuple(sorted(JOINTS))

    def __init__(self, controller: str = STREAMED, speed_scaling: float = 100.0) -> None:
        self._topic, message = CONTROLLERS[controller]
        self._scaled = controller == self._SCALED
        if not 0 <= speed_scaling <= 100:
            raise ConfigError(f"a speed slider goes from 0 to 100 %, got {speed_scaling:g}")
        self._percent = speed_scaling
        self.states = {
            "arm": ("/joint_states", JOINT_STATE),
            "gripper": ("/gripper/position", FLOAT64),
            "speed scaling": ("/speed_scaling_state_broadcaster/speed_scaling", FLOAT64),
        }
        self.latched = {
            "program running": ("/io_and_status_controller/robot_program_running", BOOL)
        }
        self.cameras = {
            "front": "/front_camera/color/image_raw",
            "wrist": "/wrist_camera/color/image_raw",
        }
        self.depths = {
            "front": "/front_camera/depth/image_raw",
            "wrist": "/wrist_camera/depth/image_raw",
        }
        self.commands = {self._topic: message, self._GRIPPER: FLOAT64}
        self.knobs = {self._SLIDER: FLOAT64}
        self.reset(np.zeros(self._ARM + 1))

    def messages(self, state: Array, now: float) -> dict[str, Any]:
        where = dict(zip(JOINTS, state, strict=False))
        self._measured = np.array(state[: self._ARM])
        arm = message_class(JOINT_STATE)()
        number = message_class(FLOAT64)
        return {
            "arm": joints.fill(arm, self._NAMES, [where[name] for name in self._NAMES]),
            "gripper": number(data=float(state[self._ARM])),
            "speed scaling": number(data=self._percent),
            "program running": message_class(BOOL)(data=True),
        }

    def receive(self, topic: str, message: Any, now: float) -> None:
        if topic == self._GRIPPER:
            self._gripper = command_values(message, ("gripper",), topic)[0]
            return
        if topic == self._SLIDER:
            self._slide(float(message.data), now)
            return
        arm = command_values(message, JOINTS, topic)
        seconds = 0.0
        if self.commands[topic] != TRAJECTORY and not is_taken(arm, self._to, self._measured):
            raise BadMessage(
                f"{topic}: positions more than {STEP:g} rad from the last one and from the arm are "
                "ignored, as the program on the robot does"
            )
        if self.commands[topic] == TRAJECTORY:
            after = message.points[-1].time_from_start
            seconds = after.sec + after.nanosec * 1e-9
        self._from, self._to = self.target(now)[: self._ARM], arm
        self._since, self._seconds = now, seconds

    def _slide(self, percent: float, now: float) -> None:
        if not 0 <= percent <= 100:
            raise BadMessage(f"{self._SLIDER}: a speed slider goes from 0 to 100 %, got {percent}")
        # What is left of a trajectory continues from here at the new speed.
        here, left = self.target(now), self._seconds - self._passed(now)
        self._from, self._since, self._seconds = here[: self._ARM], now, max(left, 0.0)
        self._percent = percent

    def _passed(self, now: float) -> float:
        return (now - self._since) * (self._percent / 100 if self._scaled else 1.0)

    def target(self, now: float) -> Array:
        share = 1.0 if self._seconds <= 0 else min(self._passed(now) / self._seconds, 1.0)
        return np.append(self._from + share * (self._to - self._from), self._gripper)

    def reset(self, state: Array) -> None:
        self._from = self._to = self._measured = np.array(state[: self._ARM])
        self._gripper = float(state[self._ARM])
        self._since = self._seconds = 0.0


def command_values(message: Any, names: Sequence[str], topic: str) -> Array:
    """``(len(names),)`` joint targets of a command, by the fields that it has.

    Raises:
        BadMessage: names are missing, it is too short, or a number is not finite.
    """
    if hasattr(message, "points"):
        if not message.points:
            raise BadMessage(f"{topic}: a trajectory without points")
        given: Any = _Named(message.joint_names, message.points[-1].positions)
        return joints.positions(given, names, topic)
    if hasattr(message, "position"):
        return joints.positions(message, names, topic)
    values = message.cmd if hasattr(message, "cmd") else message.data
    array = np.atleast_1d(np.array(values, np.float64))
    if array.shape != (len(names),):
        raise BadMessage(f"{topic}: {len(names)} values are needed, got {array.shape}")
    if not all(map(math.isfinite, array)):
        raise BadMessage(f"{topic}: a value is not finite")
    return array


class _Named:
    def __init__(self, name: Sequence[str], position: Sequence[float]) -> None:
        self.name, self.position = name, position
