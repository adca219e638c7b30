"""A small robot for these tests: three joints, a camera, and the driver that serves it."""

from __future__ import annotations

import time

import pytest

from fluxvla_core.errors import Faulted, NotReady, Rejected
from fluxvla_core.ros2 import (
    IMAGE,
    JOINT_STATE,
    CommandSpec,
    RosOperator,
    Stale,
    StreamSpec,
    camera_stream,
    joints,
    message_class,
)
from fluxvla_core.spec import Camera, EmbodimentSpec, Joint

NAMES = ("elbow", "wrist", "grip")
CAM = Camera("cam", 48, 64)
SPEC = EmbodimentSpec(
    "arm",
    (
        Joint("elbow", "rad", -1.0, 1.0, 1.0, 1.0),
        Joint("wrist", "rad", -2.0, 2.0, 1.0, 1.0),
        Joint("grip", "normalized", 0.0, 1.0, 1.0, 1.0, kind="gripper", open=1.0, closed=0.0),
    ),
    (CAM,),
    50.0,
)
STATE = {
    "topic": "/arm/state",
    "message": JOINT_STATE,
    "hz": 100,
    "names": ["grip", "finger", "elbow", "wrist"],
    "positions": [0.5, 9.0, 0.1, 0.2],
}
CAMERA = {"topic": "/cam/image", "message": IMAGE, "hz": 30, "height": 48, "width": 64}
COMMANDS = {"topic": "/arm/command", "message": JOINT_STATE}


class Arm(RosOperator):
    """Three joints and a camera."""

    embodiment = SPEC

    def __init__(self, **settings):
        # Machines that run tests stall for a second; what is silent for longer is silent.
        quick = {"connect_timeout_s": 8.0, "rate_window_s": 0.0, "max_age_s": 2.0}
        super().__init__(**{**quick, **settings})

    def streams(self):
        return [StreamSpec("arm", "/arm/state", JOINT_STATE), camera_stream(CAM, "/cam/image")]

    def commands(self):
        return [CommandSpec("/arm/command")]

    def read_state(self, messages):
        return joints.positions(messages["arm"], NAMES, "arm (/arm/state)")

    def publish_action(self, action):
        message = message_class(JOINT_STATE)()
        self.publish("/arm/command", joints.fill(message, NAMES, action))


def wait_for(condition, seconds=8.0):
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, "did not happen in time"
        time.sleep(0.01)


def frame_error(operator, what, seconds=8.0, call=None):
    """The first error of ``get_frame``, or of ``call``, that says ``what``, waiting for it.

    On a machine that is busy with others, any stream may fall silent for a moment.
    """
    until, seen = time.monotonic() + seconds, []
    while time.monotonic() < until:
        try:
            (call or operator.get_frame)()
        except (NotReady, Faulted) as error:
            if what in error.what:
                return error
            seen.append(error.what)
        time.sleep(0.01)
    pytest.fail(f"nobody said {what!r}, but {seen[-3:]}")


def frames_of(operator, count=15, seconds=8.0):
    """So many frames; streams that fall silent for a moment are forgiven."""
    until, frames = time.monotonic() + seconds, []
    while len(frames) < count:
        assert time.monotonic() < until, f"only {len(frames)} frames in {seconds} s"
        try:
            frames.append(operator.get_frame())
        except Stale:
            continue
        time.sleep(0.02)
    return frames


def refusal_of(operators, **settings):
    operator = operators(**{"connect_timeout_s": 5.0, **settings})
    with pytest.raises((NotReady, Rejected)) as caught:
        operator.connect()
    return caught.value


def rejection_of(operators, attempts=4):
    """What ``connect`` says of another commander, who may be discovered a little late."""
    for _ in range(attempts):
        operator = operators(connect_timeout_s=3.0, rate_window_s=0.5)
        try:
            operator.connect()
        except Rejected as error:
            return error
        operator.close()
    pytest.fail("another commander was never noticed")
