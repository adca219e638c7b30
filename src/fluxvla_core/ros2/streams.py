"""What an operator reads and writes, as data: topics, message types, how much is kept."""

from __future__ import annotations

from dataclasses import dataclass

from fluxvla_core.spec.embodiment import Camera

JOINT_STATE = "sensor_msgs.msg:JointState"
IMAGE = "sensor_msgs.msg:Image"
COMPRESSED_IMAGE = "sensor_msgs.msg:CompressedImage"
TWIST = "geometry_msgs.msg:Twist"
ODOMETRY = "nav_msgs.msg:Odometry"
FLOAT64 = "std_msgs.msg:Float64"
FLOAT64_ARRAY = "std_msgs.msg:Float64MultiArray"

STATE, CAMERA, DEPTH, SIDE = "state", "camera", "depth", "side"
"""What a stream is for. ``side`` streams (a robot's mode, its base) are kept and must be fresh, but
are not matched in time with the others."""

# Long enough to find the state that belongs to a picture that took 0.2 s, at 500 Hz.
_STATE_DEPTH = 128
# Pictures are large; the newest few are enough to match cameras with one another.
_PICTURE_DEPTH = 4


@dataclass(frozen=True)
class StreamSpec:
    """One subscription.

    Args:
        name: the stream's name in frames and messages; a camera's name for pictures.
        topic: the topic.
        message: its type, as ``sensor_msgs.msg:JointState``.
        kind: ``state``, ``camera``, ``depth`` or ``side``.
        depth: how many messages are kept.
        expected_hz: messages a second that should come; None: as many as are sent.
        camera: size of the pictures, for ``camera`` and ``depth``.
        required: whether ``connect`` waits for it; only ``side`` streams need not be. Without, it
            warns if nobody publishes it. What has spoken once must go on in either case.
        latched: ask for the last message that was sent before, where publishers keep it. It is sent
            when something changes, so that silence means nothing.
        unheard: the likely cause where it is not heard, for messages.
    """

    name: str
    topic: str
    message: str
    kind: str = STATE
    depth: int = _STATE_DEPTH
    expected_hz: float | None = None
    camera: Camera | None = None
    required: bool = True
    latched: bool = False
    unheard: str = ""

    @property
    def label(self) -> str:
        """Name and topic, for messages."""
        return f"{self.name} ({self.topic})"


def depth_stream(camera: str) -> str:
    """What the stream of a camera's distances is called."""
    return f"{camera}_depth"


def camera_stream(
    camera: Camera, topic: str, expected_hz: float | None = None, depth: bool = False
) -> StreamSpec:
    """The stream of a camera's pictures; of its distances (named ``<camera>_depth``) if ``depth``.

    A topic that ends in ``/compressed`` or ``/compressedDepth`` bears ``CompressedImage``, as
    image_transport names them.
    """
    packed = topic.rstrip("/").rpartition("/")[2] in ("compressed", "compressedDepth")
    return StreamSpec(
        name=depth_stream(camera.name) if depth else camera.name,
        topic=topic,
        message=COMPRESSED_IMAGE if packed else IMAGE,
        kind=DEPTH if depth else CAMERA,
        depth=_PICTURE_DEPTH,
        expected_hz=expected_hz,
        camera=camera,
    )


@dataclass(frozen=True)
class CommandSpec:
    """One publisher.

    Args:
        topic: the topic.
        message: its type, as ``sensor_msgs.msg:JointState``.
        exclusive: whether nobody else may publish there, and somebody must listen.
    """

    topic: str
    message: str = JOINT_STATE
    exclusive: bool = True
