"""Universal Robots through ur_robot_driver's ROS 2 topics, with a gripper and two cameras."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import ConfigError, Faulted, Rejected
from fluxvla_core.operators import Camera
from fluxvla_core.ros2 import (
    AUXILIARY,
    FLOAT64,
    FLOAT64_ARRAY,
    JOINT_STATE,
    BadMessage,
    CommandSpec,
    RosOperator,
    Stale,
    StreamSpec,
    camera_stream,
    joints,
    message_class,
)
from fluxvla_ur.embodiment import CAMERAS, JOINTS, RATE_HZ, ur_spec
from fluxvla_ur.readiness import check_not_paused
from fluxvla_ur.servo import STEP, STREAMED, check_rate, is_taken, servo_rate

Array = npt.NDArray[np.float64]
TRAJECTORY = "trajectory_msgs.msg:JointTrajectory"
BOOL = "std_msgs.msg:Bool"
_ARM = len(JOINTS)

CONTROLLERS: Mapping[str, tuple[str, str]] = {
    STREAMED: ("/forward_position_controller/commands", FLOAT64_ARRAY),
    "scaled_joint_trajectory_controller": (
        "/scaled_joint_trajectory_controller/joint_trajectory",
        TRAJECTORY,
    ),
    "joint_trajectory_controller": (
        "/joint_trajectory_controller/joint_trajectory",
        TRAJECTORY,
    ),
}
"""Controller -> command topic and message type. The first passes every command on as it is
(servoj); the others interpolate, and the scaled one follows the teach pendant's speed slider."""


class UROperator(RosOperator):
    """A UR arm behind ur_robot_driver.

    What the robot says is obeyed: while its program is not running (protective stop, emergency
    stop, local mode) commands are refused, and with ``forward_position_controller``, which does not
    know the speed slider, commands are slowed down to the slider's share of the speed limits.

    Args:
        model: ``ur3e``, ``ur5e`` or ``ur10e``.
        controller: the active ros2_control controller; one of ``CONTROLLERS``.
        img_front_topic, img_left_topic: colour images of the front and the wrist camera; a topic
            that ends in ``/compressed`` carries ``CompressedImage``.
        img_front_depth_topic, img_left_depth_topic: depth images.
        puppet_arm_left_topic: joint states.
        puppet_arm_left_cmd_topic: joint commands; None takes the controller's.
        puppet_gripper_left_topic: the gripper's position, a number.
        puppet_gripper_left_cmd_topic: the gripper's commands, a number.
        speed_scaling_topic: percent, from the speed scaling state broadcaster.
        program_running_topic: whether the robot's program runs, from the IO and status controller.
        require_status: whether these two must be heard before anything moves. Only without
            ur_robot_driver there is a reason to say False: a stop on the robot goes unnoticed then.
        use_depth_image: read depth into ``frame.depths``.
        publish_rate: commands a second. With ``forward_position_controller``, by default as many
            as the robot needs at full speed: 125, for the UR3e's wrists 250; too few are refused
            (``fluxvla_ur.servo`` says why). With the others 30.
        camera_names: what front and wrist camera are called, in this order; with fewer names the
            last is not used.
        height, width: of every image, in pixels.
        joint_prefix: comes before each joint's name (``tf_prefix`` of the driver).
        gripper_joint: read the gripper from this joint of the joint states instead of its topic.
        gripper_closed, gripper_open: the gripper's raw values at its ends, in state and command.
        gripper_message: type of its state and command: std_msgs ``Float64`` or ``Float32``.
        trajectory_time_s: with a trajectory controller, how far ahead each target is set.
        camera_rate_hz: images a second that should come; None: as many as are sent.
        **connection: as ``fluxvla_core.ros2.RosOperator`` takes it: ``domain_id``, how long to wait
            for streams, how old they may be.

    Raises:
        ConfigError: an unknown model or controller, or a value out of its range.
    """

    def __init__(
        self,
        model: str = "ur5e",
        controller: str = STREAMED,
        img_front_topic: str = "/front_camera/color/image_raw",
        img_left_topic: str = "/wrist_camera/color/image_raw",
        img_front_depth_topic: str = "/front_camera/depth/image_raw",
        img_left_depth_topic: str = "/wrist_camera/depth/image_raw",
        puppet_arm_left_topic: str = "/joint_states",
        puppet_arm_left_cmd_topic: str | None = None,
        puppet_gripper_left_topic: str = "/gripper/position",
        puppet_gripper_left_cmd_topic: str = "/gripper/command",
        speed_scaling_topic: str = "/speed_scaling_state_broadcaster/speed_scaling",
        program_running_topic: str = "/io_and_status_controller/robot_program_running",
        require_status: bool = True,
        use_depth_image: bool = False,
        publish_rate: float | None = None,
        camera_names: Sequence[str] = tuple(camera.name for camera in CAMERAS),
        height: int = 480,
        width: int = 640,
        joint_prefix: str = "",
        gripper_joint: str | None = None,
        gripper_closed: float = 0.0,
        gripper_open: float = 1.0,
        gripper_message: str = FLOAT64,
        trajectory_time_s: float = 0.1,
        camera_rate_hz: float | None = None,
        **connection: Any,
    ) -> None:
        super().__init__(**connection)
        if controller not in CONTROLLERS:
            raise ConfigError(
                f"unknown controller {controller!r}; known are {', '.join(CONTROLLERS)}"
            )
        if len(camera_names) > len(CAMERAS):
            raise ConfigError(f"there are {len(CAMERAS)} cameras, got {list(camera_names)}")
        if not 0 < abs(gripper_open - gripper_closed) < math.inf:
            raise ConfigError("gripper_closed and gripper_open must be different finite numbers")
        if not 0 < trajectory_time_s < math.inf:
            raise ConfigError(f"trajectory_time_s must be positive, got {trajectory_time_s}")
        try:
            cameras = tuple(Camera(name, height, width) for name in camera_names)
            usual = ur_spec(model, cameras, RATE_HZ)
            default = servo_rate(usual) if controller == STREAMED else RATE_HZ
            rate = default if publish_rate is None else publish_rate
            self.embodiment = ur_spec(model, cameras, rate)
        except ValueError as error:
            raise ConfigError(f"UROperator: {error}") from error
        self._streamed = controller == STREAMED
        if self._streamed:
            check_rate(self.embodiment)
        topic, self._arm_message = CONTROLLERS[controller]
        self._arm_command = puppet_arm_left_cmd_topic or topic
        self._images = (img_front_topic, img_left_topic)
        self._depths = (img_front_depth_topic, img_left_depth_topic)
        self._arm_state = puppet_arm_left_topic
        self._gripper_state = puppet_gripper_left_topic
        self._gripper_command = puppet_gripper_left_cmd_topic
        self._scaling_topic = speed_scaling_topic
        self._running_topic = program_running_topic
        self._require_status = require_status
        self._use_depth = use_depth_image
        self._names = tuple(joint_prefix + name for name in JOINTS)
        self._gripper_joint = gripper_joint
        self._gripper_ends = gripper_closed, gripper_open
        self._gripper_message = gripper_message
        self._trajectory_time = trajectory_time_s
        self._camera_hz = camera_rate_hz

    def streams(self) -> Sequence[StreamSpec]:
        found = [StreamSpec("arm", self._arm_state, JOINT_STATE)]
        cameras = self.embodiment.cameras
        for camera, colour, depth in zip(cameras, self._images, self._depths, strict=False):
            found.append(camera_stream(camera, colour, self._camera_hz))
            if self._use_depth:
                found.append(camera_stream(camera, depth, self._camera_hz, depth=True))
        if self._gripper_joint is None:
            # A bare number has no stamp, so it cannot be matched in time with the others.
            found.append(
                StreamSpec(
                    "gripper", self._gripper_state, self._gripper_message, AUXILIARY, depth=1
                )
            )
        hint = " (drivers that have none: require_status=False)" if self._require_status else ""
        scaling = StreamSpec(
            "speed scaling",
            self._scaling_topic,
            FLOAT64,
            AUXILIARY,
            depth=1,
            required=self._require_status,
            unheard="the driver's speed_scaling_state_broadcaster is not active, or has another "
            f"name{hint}",
        )
        running = StreamSpec(
            "program running",
            self._running_topic,
            BOOL,
            AUXILIARY,
            depth=1,
            required=self._require_status,
            latched=True,
            # The driver publishes changes only, and begins with a program that does not run.
            unheard="External Control was not played on the teach pendant since the driver "
            f"started, or its io_and_status_controller has another name{hint}",
        )
        return [*found, scaling, running]

    def commands(self) -> Sequence[CommandSpec]:
        return [
            CommandSpec(self._arm_command, self._arm_message),
            CommandSpec(self._gripper_command, self._gripper_message),
        ]

    def read_state(self, messages: Mapping[str, Any]) -> Array:
        closed, opened = self._gripper_ends
        label = f"arm ({self._arm_state})"
        if self._gripper_joint is not None:
            names = (*self._names, self._gripper_joint)
            state = joints.positions(messages["arm"], names, label)
        else:
            arm = joints.positions(messages["arm"], self._names, label)
            state = np.append(arm, self._gripper_position())
        state[_ARM] = (state[_ARM] - closed) / (opened - closed)
        return state

    @property
    def speed_scaling(self) -> float:
        """Share of the programmed speed that the robot runs at, 0 to 1; 1 where it does not say."""
        received = self.newest("speed scaling")
        if received is None:
            return 1.0
        percent = float(received.message.data)
        if not math.isfinite(percent):
            raise BadMessage(f"the speed scaling ({self._scaling_topic}) is {percent}")
        return min(max(percent / 100.0, 0.0), 1.0)

    def check_command(self, action: Array) -> None:
        running = self.newest("program running")
        if running is not None and not running.message.data:
            raise Faulted(
                "the robot's program is not running, and it ignores commands",
                cause="a protective or emergency stop, local mode, or External Control ended",
                next="look at the teach pendant, clear the stop, and play the program again",
            )
        check_not_paused(self.speed_scaling)
        if self._streamed:
            self._check_step(action[:_ARM])

    def publish_action(self, action: Array) -> None:
        closed, opened = self._gripper_ends
        command = message_class(self._arm_message)()
        if self._arm_message == TRAJECTORY:
            self._fill_trajectory(command, action[:_ARM])
        else:
            command.data = action[:_ARM].tolist()
        self.publish(self._arm_command, command)
        gripper = message_class(self._gripper_message)()
        gripper.data = float(closed + action[_ARM] * (opened - closed))
        self.publish(self._gripper_command, gripper)

    def _fill_trajectory(self, command: Any, positions: Array) -> None:
        point = message_class("trajectory_msgs.msg:JointTrajectoryPoint")()
        point.positions = positions.tolist()
        seconds, nanoseconds = divmod(round(self._trajectory_time * 1e9), 10**9)
        point.time_from_start.sec, point.time_from_start.nanosec = seconds, nanoseconds
        command.joint_names = list(self._names)
        command.points = [point]

    def _check_step(self, target: Array) -> None:
        last = self.last_action
        if last is not None and is_taken(target, last[:_ARM]):
            return
        if not is_taken(target, self.get_state()[:_ARM]):
            raise Rejected(
                f"the command is more than {STEP:g} rad from the last one and from where the arm "
                "is: the robot would ignore it, and those after it",
                cause="commands come too rarely for their speed, or one of them is a jump",
                next="leave out publish_rate in operator and runner, or interpolate",
            )

    def _gripper_position(self) -> float:
        received = self.newest("gripper")
        if received is None:
            raise Stale(f"the gripper ({self._gripper_state}) has not said where it is")
        value = float(received.message.data)
        if not math.isfinite(value):
            raise BadMessage(f"the gripper ({self._gripper_state}) reports {value}")
        return value
