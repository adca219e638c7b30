"""ALOHA on ROS 2: two puppet arms, up to three cameras, depth and a mobile base if wanted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fluxvla_aloha.arms import ARMS
from fluxvla_aloha.base import TIMEOUT_S, BaseDrive
from fluxvla_aloha.embodiment import CAMERAS, GRIPPERS, RATE_HZ, aloha_spec
from fluxvla_aloha.presets import PRESETS, Preset
from fluxvla_core.errors import ConfigError, NotReady, Rejected
from fluxvla_core.operators import Camera, EmbodimentSpec, Joint
from fluxvla_core.ros2 import (
    AUXILIARY,
    JOINT_STATE,
    ODOMETRY,
    STATE,
    TWIST,
    BadMessage,
    CommandSpec,
    Connection,
    RosOperator,
    StreamSpec,
    camera_stream,
    joints,
    message_class,
)

if TYPE_CHECKING:
    from fluxvla_core.operators import RunContext

Array = npt.NDArray[np.float64]
SIDES = ("left", "right")
_ARM = 7
# The group that Interbotix's drivers know an arm's six joints by.
_GROUP = "arm"


class AlohaOperator(RosOperator):
    """An ALOHA behind its ROS 2 topics. A topic that is not given is the preset's.

    Args:
        preset: ``cobot_magic`` (AgileX) or ``interbotix``.
        img_front_topic, img_left_topic, img_right_topic: colour images; a topic that ends in
            ``/compressed`` carries ``CompressedImage``.
        img_front_depth_topic, img_left_depth_topic, img_right_depth_topic: depth images.
        puppet_arm_left_topic, puppet_arm_right_topic: joint states of the arms.
        puppet_arm_left_cmd_topic, puppet_arm_right_cmd_topic: their commands.
        puppet_gripper_left_cmd_topic, puppet_gripper_right_cmd_topic: commands of the grippers,
            where the arms' commands do not hold them.
        robot_base_topic, robot_base_cmd_topic: odometry and velocity of the base.
        use_depth_image: read depth into ``frame.depths``.
        use_robot_base: read the base's speed into ``frame.base``, and allow :meth:`drive`.
        policy_drives_base: the base's forward and turning speed are the last two of the policy's
            actions and of the state (``base_forward`` in m/s, ``base_turn`` in rad/s), as Mobile
            ALOHA has them; nobody else may drive it then. It comes to rest in every hold and stop.
        publish_rate: commands a second.
        camera_names: what front, left and right camera are called, in this order; with fewer names
            the last cameras are not used.
        height, width: of every image, in pixels.
        joint_names: names of an arm's six joints and gripper in its messages.
        gripper_closed, gripper_open: a gripper's raw values at its ends.
        arm_message, gripper_message: types of the commands: ``sensor_msgs.msg:JointState``, one
            with a field ``cmd`` as Interbotix has, or a std_msgs array or number.
        base_max_linear, base_max_angular: largest speeds of the base, in m/s and rad/s.
        base_max_linear_acceleration, base_max_angular_acceleration: how fast a policy may change
            them, in m/s^2 and rad/s^2.
        camera_rate_hz: images a second that should come; None: as many as are sent.
        arms: ``viperx300``, ``arx_x5`` or ``piper``: whose limits are kept. The preset
            ``interbotix`` has the first; with ``cobot_magic`` nobody but you can tell, and without
            them :meth:`connect` refuses.
        embodiment: in place of ``arms``, the spec of others (as ``EmbodimentSpec.to_dict`` gives
            it), with seven joints an arm, left first, gripper last.
        context: what the run knows (injected).
        **connection: as ``fluxvla_core.ros2.RosOperator`` takes it: ``domain_id``, how long to wait
            for streams, how old they may be.

    Raises:
        ConfigError: an unknown preset, or a value out of its range.
    """

    def __init__(
        self,
        preset: str = "cobot_magic",
        img_front_topic: str | None = None,
        img_left_topic: str | None = None,
        img_right_topic: str | None = None,
        img_front_depth_topic: str | None = None,
        img_left_depth_topic: str | None = None,
        img_right_depth_topic: str | None = None,
        puppet_arm_left_topic: str | None = None,
        puppet_arm_right_topic: str | None = None,
        puppet_arm_left_cmd_topic: str | None = None,
        puppet_arm_right_cmd_topic: str | None = None,
        puppet_gripper_left_cmd_topic: str | None = None,
        puppet_gripper_right_cmd_topic: str | None = None,
        robot_base_topic: str | None = None,
        robot_base_cmd_topic: str | None = None,
        use_depth_image: bool = False,
        use_robot_base: bool = False,
        policy_drives_base: bool = False,
        publish_rate: float = RATE_HZ,
        camera_names: Sequence[str] = tuple(camera.name for camera in CAMERAS),
        height: int = 480,
        width: int = 640,
        joint_names: Sequence[str] | None = None,
        gripper_closed: float | None = None,
        gripper_open: float | None = None,
        arm_message: str | None = None,
        gripper_message: str | None = None,
        base_max_linear: float = 0.3,
        base_max_angular: float = 0.5,
        base_max_linear_acceleration: float = 0.5,
        base_max_angular_acceleration: float = 1.0,
        camera_rate_hz: float | None = None,
        arms: str | None = None,
        embodiment: Mapping[str, Any] | None = None,
        context: RunContext | None = None,
        **connection: Any,
    ) -> None:
        super().__init__(**connection)
        known = PRESETS.get(preset)
        if known is None:
            raise ConfigError(f"unknown ALOHA preset {preset!r}; known are {', '.join(PRESETS)}")
        if len(camera_names) > len(CAMERAS):
            raise ConfigError(f"an ALOHA has {len(CAMERAS)} cameras, got {list(camera_names)}")
        cameras = tuple(Camera(name, height, width) for name in camera_names)
        kind = arms or known.arms
        self._are_known = kind is not None or embodiment is not None
        self._place = context and context.where(f"{context.section}.operator")
        self.embodiment = _spec(embodiment, arms, kind, cameras, publish_rate)
        self._images = _given(known.images, img_front_topic, img_left_topic, img_right_topic)
        self._depths = _given(
            known.depths, img_front_depth_topic, img_left_depth_topic, img_right_depth_topic
        )
        self._states = _given(known.states, puppet_arm_left_topic, puppet_arm_right_topic)
        self._arms = _given(known.commands, puppet_arm_left_cmd_topic, puppet_arm_right_cmd_topic)
        self._grippers = _given(
            known.gripper_commands or ("", ""),
            puppet_gripper_left_cmd_topic,
            puppet_gripper_right_cmd_topic,
        )
        self._base_topics = _given(
            (known.odometry, known.velocity), robot_base_topic, robot_base_cmd_topic
        )
        self._use_depth = use_depth_image
        self._use_base = use_robot_base or policy_drives_base
        self._policy_drives = policy_drives_base
        self._names = tuple(joint_names or known.joints)
        if len(self._names) != _ARM:
            raise ConfigError(f"joint_names are {_ARM} names of one arm, got {list(self._names)}")
        self._gripper_closed, self._gripper_open = _gripper_ends(
            known, kind, gripper_closed, gripper_open
        )
        self._arm_message = arm_message or known.arm_message
        self._gripper_message = gripper_message or known.gripper_message
        self._camera_hz = camera_rate_hz
        self._messages: dict[str, Any] = {}
        self._drive = BaseDrive(
            lambda message: self.publish(self._base_topics[1], message),
            lambda: message_class(TWIST)(),
            base_max_linear,
            base_max_angular,
        )
        if policy_drives_base:
            base = (
                Joint.base("base_forward", "m/s", base_max_linear, base_max_linear_acceleration),
                Joint.base("base_turn", "rad/s", base_max_angular, base_max_angular_acceleration),
            )
            self.embodiment = replace(self.embodiment, joints=(*self.embodiment.joints, *base))

    def connect(self) -> None:
        """As ``RosOperator`` does it, once it is known which arms are there.

        Raises:
            ConfigError: nobody said so; nothing is opened.
        """
        if not self._are_known:
            raise ConfigError(
                "which arms this ALOHA has is not known, and so not within which limits they may "
                f"move; known are {', '.join(ARMS)}",
                where=self._place,
                cause="cobot_magic is sold with ARX X5 and with AgileX PiPER arms, behind the same "
                "topics",
                next="look at the arms, then --set <AlohaOperator>.arms=arx_x5 or "
                "--set <AlohaOperator>.arms=piper; others are described with embodiment=dict(…)",
            )
        super().connect()

    def streams(self) -> Sequence[StreamSpec]:
        found = [
            StreamSpec(f"{side} arm", topic, JOINT_STATE)
            for side, topic in zip(SIDES, self._states, strict=True)
        ]
        cameras = self.embodiment.cameras
        for camera, colour, depth in zip(cameras, self._images, self._depths, strict=False):
            found.append(camera_stream(camera, colour, self._camera_hz))
            if self._use_depth:
                found.append(camera_stream(camera, depth, self._camera_hz, depth=True))
        if self._use_base:
            kind = STATE if self._policy_drives else AUXILIARY
            found.append(StreamSpec("base", self._base_topics[0], ODOMETRY, kind, depth=1))
        return found

    def commands(self) -> Sequence[CommandSpec]:
        found = [CommandSpec(topic, self._arm_message) for topic in self._arms]
        found += [CommandSpec(topic, self._gripper_message) for topic in self._grippers if topic]
        if self._use_base:
            found.append(CommandSpec(self._base_topics[1], TWIST))
        return found

    def read_state(self, messages: Mapping[str, Any]) -> Array:
        arms = [
            joints.positions(messages[f"{side} arm"], self._names, f"{side} arm ({topic})")
            for side, topic in zip(SIDES, self._states, strict=True)
        ]
        state = np.concatenate(arms)
        for column in GRIPPERS:
            state[column] = (state[column] - self._gripper_closed) / (
                self._gripper_open - self._gripper_closed
            )
        if self._policy_drives:
            state = np.concatenate([state, self._base_speeds(messages)])
        return state

    def read_base(self, messages: Mapping[str, Any]) -> Array | None:
        return self._base_speeds(messages) if self._use_base else None

    def _base_speeds(self, messages: Mapping[str, Any]) -> Array:
        twist = messages["base"].twist.twist
        speeds = np.array([twist.linear.x, twist.angular.z])
        if not np.isfinite(speeds).all():
            raise BadMessage(f"base ({self._base_topics[0]}): its speed is {speeds.tolist()}")
        return speeds

    def publish_action(self, action: Array) -> None:
        for index, arm_topic in enumerate(self._arms):
            arm = action[_ARM * index : _ARM * (index + 1)].copy()
            arm[-1] = self._gripper_closed + arm[-1] * (self._gripper_open - self._gripper_closed)
            gripper_topic = self._grippers[index]
            if not gripper_topic:
                self._command(arm_topic, self._arm_message, self._names, arm, _GROUP)
                continue
            name = self._names[-1]
            self._command(arm_topic, self._arm_message, self._names[:-1], arm[:-1], _GROUP)
            self._command(gripper_topic, self._gripper_message, (name,), arm[-1:], name)
        if self._policy_drives:
            self._drive.drive(*action[2 * _ARM :].tolist())

    def drive(self, linear: float, angular: float) -> None:
        """Drive the base at ``linear`` m/s forward and ``angular`` rad/s.

        The speed ends a quarter of a second later unless it is asked for again, and in ``stop``.

        Raises:
            Rejected: this operator has no base, the policy drives it, or a speed is not finite or
                beyond its limit.
            NotReady: not connected.
        """
        if self._policy_drives:
            raise Rejected("the policy drives the base", next="policy_drives_base=False")
        if not self._use_base:
            raise Rejected(
                "the base is not used", next=f"--set <{type(self).__name__}>.use_robot_base=true"
            )
        with self._lock:
            if self._connection is None:
                raise NotReady("aloha is not connected", next="call connect() first")
            self._drive.drive(linear, angular)

    def on_connected(self, connection: Connection) -> None:
        if self._use_base:
            connection.every(TIMEOUT_S / 5, self._tick)

    def on_stop(self) -> None:
        # What the policy drives is braked with the arm, and stays at 0.
        if self._use_base and not self._policy_drives:
            self._drive.halt()

    def _tick(self) -> None:
        with self._lock:
            if self._connection is not None:
                self._drive.tick()

    def _command(
        self, topic: str, message: str, names: Sequence[str], values: Array, group: str
    ) -> None:
        # One message a topic, filled anew: the middleware copies it when it is published.
        command = self._messages.get(topic)
        if command is None:
            command = self._messages[topic] = message_class(message)()
        self.publish(topic, fill_command(command, names, values, group))


def fill_command(message: Any, names: Sequence[str], values: Array, group: str) -> Any:
    """Put joint targets into a command message, by the fields that it has; returns it.

    ``position`` (JointState): names and values. ``cmd`` (Interbotix): ``group`` as name, values;
    one number where there is one joint. ``data`` (std_msgs): values, or one number.

    Raises:
        ConfigError: it has none of these fields.
    """
    if hasattr(message, "position"):
        return joints.fill(message, names, values)
    numbers = np.asarray(values, np.float64).tolist()
    field = next((name for name in ("cmd", "data") if hasattr(message, name)), None)
    if field is None:
        raise ConfigError(
            f"{type(message).__name__} has none of the fields position, cmd and data: "
            "it cannot carry joint targets"
        )
    if field == "cmd":
        message.name = group
    single = isinstance(getattr(message, field), float)
    setattr(message, field, numbers[0] if single else numbers)
    return message


def _given(preset: Sequence[str], *topics: str | None) -> tuple[str, ...]:
    return tuple(topic or default for topic, default in zip(topics, preset, strict=True))


def _gripper_ends(
    preset: Preset, arms: str | None, closed: float | None, opened: float | None
) -> tuple[float, float]:
    """A gripper's raw values, closed and open: the config's, the arms', or the preset's."""
    own = None if arms is None else ARMS[arms].gripper_ends
    usual = own or (preset.gripper_closed, preset.gripper_open)
    ends = usual[0] if closed is None else closed, usual[1] if opened is None else opened
    if not 0 < abs(ends[1] - ends[0]) < float("inf"):
        raise ConfigError("gripper_closed and gripper_open must be different finite numbers")
    return ends


def _spec(
    given: Mapping[str, Any] | None,
    arms: str | None,
    kind: str | None,
    cameras: tuple[Camera, ...],
    rate_hz: float,
) -> EmbodimentSpec:
    if given is not None and arms is not None:
        raise ConfigError("arms and embodiment both say which arms there are; give one of them")
    try:
        # Without known arms connect() refuses; until then there must be some spec.
        usual = aloha_spec(cameras, rate_hz, kind or "viperx300")
    except ValueError as error:
        raise ConfigError(f"AlohaOperator: {error}") from error
    if given is None:
        return usual
    spec = EmbodimentSpec.from_dict(given)
    kinds = [joint.kind == "gripper" for joint in spec.joints]
    if kinds != [joint.kind == "gripper" for joint in usual.joints]:
        raise ConfigError(
            f"embodiment {spec.name}: AlohaOperator commands two arms of six joints and a gripper, "
            f"left first; got {list(spec.joint_names)}"
        )
    return EmbodimentSpec(
        spec.name, spec.joints, cameras, rate_hz, spec.action_mode, source=spec.source
    )
