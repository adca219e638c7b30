"""An event of an episode as ROS 2 messages, and back.

What ROS has a type for is a message of that type, so that any ROS tool plots it: joint vectors are
``sensor_msgs/JointState``, a base's speed is a ``nav_msgs/Odometry``, a policy's chunk is a
``trajectory_msgs/JointTrajectory``, images are ``sensor_msgs/Image``, or ``CompressedImage``
where nobody looked at them; depth is ``16UC1``. The rest of the event is JSON in a
``std_msgs/String``, which comes after those messages and completes the event. No value is written
twice.
"""

from __future__ import annotations

import importlib.util
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.data.lerobot import MOST_PIXELS
from fluxvla_core.data.video_decode import image_size
from fluxvla_core.errors import DataError, RunFailed
from fluxvla_core.robot.recording.episode_log import parse_event
from fluxvla_core.ros2.images import to_depth, to_millimetres

ROOT = "/fluxvla"
EVENTS = f"{ROOT}/events"
CAMERAS = f"{ROOT}/camera/"
VECTORS: Mapping[str, str] = {
    "state": f"{ROOT}/state",
    "wanted": f"{ROOT}/target",
    "command": f"{ROOT}/command",
}
"""Field of an event -> topic of its ``JointState``."""
BASES = f"{ROOT}/base"
BASE = "base"
CHUNKS = f"{ROOT}/chunk"
# The name of a chunk's actions in the recording format.
KEYFRAMES = "keyframes"

STRING = "std_msgs/msg/String"
JOINT_STATE = "sensor_msgs/msg/JointState"
ODOMETRY = "nav_msgs/msg/Odometry"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
IMAGE = "sensor_msgs/msg/Image"
JPEG = "sensor_msgs/msg/CompressedImage"
IMAGE_TYPES = (IMAGE, JPEG)

_QUALITY = 90
_FIELDS = {topic: field for field, topic in VECTORS.items()}


def typestore() -> Any:
    """rosbags' message types.

    Raises:
        RunFailed: rosbags is not installed.
    """
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise RunFailed(
            "a recording is an MCAP file, and the package 'rosbags' is not installed",
            next="pip install 'fluxvla-core[record]'",
        ) from error
    # The oldest release that is in use: these types are the same in all that came after.
    return get_typestore(Stores.ROS2_HUMBLE)


def camera_topic(camera: str, kind: str = IMAGE) -> str:
    """The topic of a camera's images; ``frame_id`` has the camera's true name."""
    topic = CAMERAS + (re.sub(r"[^0-9A-Za-z_]", "_", camera) or "_")
    return topic if kind == IMAGE else f"{topic}/compressed"


def depth_topic(camera: str) -> str:
    """The topic of a camera's depth images."""
    return f"{camera_topic(camera)}/depth"


def has_jpeg() -> bool:
    """Whether there is what makes JPEGs."""
    return importlib.util.find_spec("cv2") is not None


def nanoseconds(seconds: float) -> int:
    """Whole nanoseconds."""
    return round(seconds * 1e9)


class Packer:
    """Makes messages.

    Args:
        store: the message types, from ``typestore``.
    """

    def __init__(self, store: Any) -> None:
        self._store = store

    def event(
        self,
        event: Mapping[str, Any],
        stamps: Mapping[str, int],
        names: Mapping[str, Sequence[str]],
    ) -> Iterator[tuple[str, str, memoryview]]:
        """Topic, type and CDR of each message that an event becomes; the JSON comes last.

        Args:
            event: with ``event`` and ``t``; its arrays must have the lengths of their ``names``.
            stamps: ``t``, and ``observed`` if the event has that, in nanoseconds of real time.
            names: ``state`` and ``action`` -> joint names.

        Raises:
            TypeError: a value is no JSON.
        """
        rest = dict(event)
        for field, topic in VECTORS.items():
            values = rest.get(field)
            if values is None:
                continue
            del rest[field]
            of = names["state" if field == "state" else "action"]
            yield topic, JOINT_STATE, self._joints(values, of, stamps["t"])
        if rest.get(BASE) is not None:
            yield BASES, ODOMETRY, self._odometry(rest.pop(BASE), stamps["t"])
        if rest.get(KEYFRAMES) is not None:
            chunk = np.asarray(rest.pop(KEYFRAMES), dtype=np.float64)
            message = self._trajectory(
                chunk, names["action"], stamps["observed"], float(rest["rate_hz"])
            )
            yield CHUNKS, TRAJECTORY, message
        text = json.dumps(rest, default=numpy_as_json)
        kind = self._store.types[STRING]
        yield EVENTS, STRING, self._store.serialize_cdr(kind(text), STRING)

    def image(self, camera: str, image: npt.NDArray[np.uint8], ns: int) -> memoryview:
        """The CDR of an ``Image``: ``(H, W, 3)`` uint8 RGB."""
        return self._image(camera, image, "rgb8", ns)

    def depth(self, camera: str, metres: npt.NDArray[np.float32], ns: int) -> memoryview:
        """The CDR of an ``Image`` of ``(H, W)`` distances: whole millimetres, 0 for nothing.

        NaN is nothing, as is what is farther than the 65.535 m that the encoding reaches.
        """
        return self._image(camera, to_millimetres(metres).astype("<u2"), "16UC1", ns)

    def jpeg(self, camera: str, image: npt.NDArray[np.uint8], ns: int) -> memoryview:
        """The CDR of a ``CompressedImage``: ``(H, W, 3)`` uint8 RGB; loses a little."""
        import cv2

        bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
        done, coded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        if not done:
            raise RunFailed(f"an image of {camera} cannot be made a JPEG")
        message = self._store.types[JPEG](
            header=self._header(ns, camera), format="jpeg", data=np.asarray(coded).reshape(-1)
        )
        packed: memoryview = self._store.serialize_cdr(message, JPEG)
        return packed

    def _joints(self, values: Any, names: Sequence[str], ns: int) -> memoryview:
        empty = np.zeros(0)
        message = self._store.types[JOINT_STATE](
            header=self._header(ns),
            name=list(names),
            position=np.asarray(values, dtype=np.float64),
            velocity=empty,
            effort=empty,
        )
        packed: memoryview = self._store.serialize_cdr(message, JOINT_STATE)
        return packed

    def _image(self, camera: str, pixels: npt.NDArray[Any], encoding: str, ns: int) -> memoryview:
        """The CDR of an ``Image``; ``pixels`` are little-endian."""
        height, width = pixels.shape[:2]
        data = np.ascontiguousarray(pixels).reshape(-1).view(np.uint8)
        message = self._store.types[IMAGE](
            header=self._header(ns, camera),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=0,
            step=data.size // height,
            data=data,
        )
        packed: memoryview = self._store.serialize_cdr(message, IMAGE)
        return packed

    def _odometry(self, speeds: Any, ns: int) -> memoryview:
        types, unknown = self._store.types, np.zeros(36)
        # Only speeds were read; a negative variance says that the pose is none.
        unknown[0] = -1.0
        forward, turning = map(float, speeds)
        vector = types["geometry_msgs/msg/Vector3"]
        pose = types["geometry_msgs/msg/Pose"](
            position=types["geometry_msgs/msg/Point"](0.0, 0.0, 0.0),
            orientation=types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
        )
        twist = types["geometry_msgs/msg/Twist"](
            linear=vector(forward, 0.0, 0.0), angular=vector(0.0, 0.0, turning)
        )
        message = types[ODOMETRY](
            header=self._header(ns, "odom"),
            child_frame_id="base_link",
            pose=types["geometry_msgs/msg/PoseWithCovariance"](pose, unknown),
            twist=types["geometry_msgs/msg/TwistWithCovariance"](twist, np.zeros(36)),
        )
        packed: memoryview = self._store.serialize_cdr(message, ODOMETRY)
        return packed

    def _trajectory(
        self, chunk: npt.NDArray[np.float64], names: Sequence[str], ns: int, rate_hz: float
    ) -> memoryview:
        types, empty = self._store.types, np.zeros(0)
        duration = types["builtin_interfaces/msg/Duration"]
        point = types["trajectory_msgs/msg/JointTrajectoryPoint"]
        points = [
            point(
                positions=row,
                velocities=empty,
                accelerations=empty,
                effort=empty,
                time_from_start=duration(*divmod(nanoseconds((index + 1) / rate_hz), 10**9)),
            )
            for index, row in enumerate(chunk)
        ]
        message = types[TRAJECTORY](header=self._header(ns), joint_names=list(names), points=points)
        packed: memoryview = self._store.serialize_cdr(message, TRAJECTORY)
        return packed

    def _header(self, ns: int, frame: str = "") -> Any:
        types = self._store.types
        stamp = types["builtin_interfaces/msg/Time"](*divmod(ns, 10**9))
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


class Unpacker:
    """Puts events together again.

    Args:
        store: the message types, from ``typestore``.
    """

    def __init__(self, store: Any) -> None:
        self._store = store
        self._parts: dict[str, Any] = {}
        self._of = -1

    def add(self, topic: str, kind: str, ns: int, data: memoryview) -> dict[str, Any] | None:
        """The event that this message completes, with arrays as lists; None for a part of one.

        Raises:
            DataError: the message is not what ``Packer`` makes.
        """
        if ns != self._of:
            self._parts, self._of = {}, ns
        if kind == TRAJECTORY:
            points = self._read(data, kind).points
            self._parts[KEYFRAMES] = [point.positions.tolist() for point in points]
        elif kind == ODOMETRY:
            twist = self._read(data, kind).twist.twist
            self._parts[BASE] = [twist.linear.x, twist.angular.z]
        elif topic in _FIELDS:
            self._parts[_FIELDS[topic]] = self._read(data, kind).position.tolist()
        elif topic == EVENTS:
            event = parse_event(self._read(data, kind).data, "an event of the recording")
            parts, self._parts = self._parts, {}
            return {**event, **parts}
        return None

    def image(self, data: memoryview, kind: str = IMAGE) -> npt.NDArray[np.uint8]:
        """``(H, W, 3)`` uint8 RGB, a fresh array.

        Raises:
            DataError: it is a JPEG, and damaged, or there is nothing to decode it with.
        """
        message = self._read(data, kind)
        if kind == IMAGE:
            shape = message.height, message.width, 3
            pixels = np.array(message.data, np.uint8)
            if pixels.size != shape[0] * shape[1] * 3:
                raise DataError(f"a recorded image of {shape[0]} x {shape[1]} is cut short")
            return pixels.reshape(shape)
        if not has_jpeg():
            raise DataError(
                "the recording has JPEGs, and the package 'cv2' is not installed",
                next="pip install 'fluxvla-core[record]'",
            )
        import cv2

        size = image_size(message.data.tobytes())
        small = size is not None and size[0] * size[1] <= MOST_PIXELS
        bgr = cv2.imdecode(message.data, cv2.IMREAD_COLOR) if small else None
        if bgr is None:
            raise DataError(f"a recorded image of {message.header.frame_id} is no JPEG")
        return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)

    def depth(self, data: memoryview, kind: str = IMAGE) -> npt.NDArray[np.float32]:
        """``(H, W)`` float32 metres, NaN where nothing was measured; a fresh array."""
        message = self._read(data, kind)
        # As what a camera sends is read, so that the same numbers come back.
        return to_depth(message, message.height, message.width, "a recording")

    def _read(self, data: memoryview, kind: str) -> Any:
        try:
            return self._store.deserialize_cdr(data, kind)
        except Exception as error:  # whatever damaged bytes make rosbags raise
            raise DataError(f"a recorded {kind} cannot be read: {error}") from error


def numpy_as_json(value: Any) -> Any:
    """Arrays and numpy's numbers as JSON has them.

    Raises:
        TypeError: it is neither.
    """
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a trace holds JSON values and arrays, not {type(value).__name__}")
