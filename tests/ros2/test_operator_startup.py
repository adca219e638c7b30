"""Connecting a ROS 2 operator, each time to drivers in processes of their own."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from fluxvla_core.errors import ConfigError, NotReady
from fluxvla_core.ros2 import AUXILIARY, JOINT_STATE, StreamSpec, camera_stream, qos
from tests.ros2.arm import (
    CAM,
    CAMERA,
    COMMANDS,
    STATE,
    Arm,
    frame_error,
    frames_of,
    refusal_of,
    wait_for,
)


def test_missing_topics_are_named_with_those_that_exist(operators, drivers):
    drivers([{**STATE, "topic": "/arm/states"}], [COMMANDS])
    error = refusal_of(operators)

    assert error.what == (
        "no publisher on /arm/state (arm); no publisher on /cam/image (cam); "
        "published are /arm/states"
    )
    assert error.next == "is /arm/state here /arm/states?"


def test_another_type_is_named(operators, drivers):
    packed = "sensor_msgs.msg:CompressedImage"
    drivers([STATE, {**CAMERA, "message": packed, "format": "jpeg"}], [COMMANDS])
    error = refusal_of(operators)

    assert error.what.startswith("cam (/cam/image) is published as sensor_msgs/msg/CompressedImage")


@pytest.mark.parametrize(("form", "off"), [("jpeg", 4), ("png", 0)])
def test_compressed_images_are_read(operators, drivers, monkeypatch, form, off):
    topic = "/cam/image/compressed"
    monkeypatch.setattr(
        Arm,
        "streams",
        lambda _: [StreamSpec("arm", "/arm/state", JOINT_STATE), camera_stream(CAM, topic)],
    )
    packed = "sensor_msgs.msg:CompressedImage"
    drivers([STATE, {**CAMERA, "topic": topic, "message": packed, "format": form}], [COMMANDS])
    operator = operators()
    operator.connect()

    seen = operator.get_frame().images["cam"]
    assert np.abs(seen.astype(int) - [10, 20, 30]).max() <= off


def test_a_publisher_that_never_sends_is_named(operators, drivers):
    drivers([STATE, CAMERA], [COMMANDS]).tell(fault="/cam/image=drop")
    time.sleep(0.2)
    error = refusal_of(operators)

    assert error.what.endswith("no message arrives on cam (/cam/image)")


def test_commands_that_nobody_hears_are_an_error(operators, drivers):
    drivers([STATE, CAMERA])

    assert refusal_of(operators).what.startswith("nobody listens on /arm/command")


def test_the_shared_memory_trap_is_named_at_start_up(drivers, operators):
    large = {**CAMERA, "height": 1536, "width": 2048, "best_effort": True}
    drivers([STATE, large], [COMMANDS])
    operator = operators(rate_window_s=0.5)

    with pytest.raises(NotReady, match=r"cam \(/cam/image\): \d of ") as caught:
        operator.connect()

    assert "512 KB" in caught.value.cause
    assert "fastdds_large_frames.xml" in caught.value.next


def test_a_lossy_stream_is_a_warning(drivers, operators, caplog, monkeypatch):
    def streams(self):
        return [
            StreamSpec("arm", "/arm/state", JOINT_STATE, expected_hz=160.0),
            camera_stream(CAM, "/cam/image"),
        ]

    monkeypatch.setattr(Arm, "streams", streams)
    drivers([STATE, CAMERA], [COMMANDS])
    operators(rate_window_s=0.5).connect()

    assert "arm (/arm/state): " in caplog.text
    assert "messages arrived in 0.5 s" in caplog.text


def test_images_from_another_dds_are_a_warning(drivers, operators, caplog, monkeypatch):
    monkeypatch.setattr(qos, "_vendor", lambda offer: b"\x01\x10")
    drivers([STATE, CAMERA], [COMMANDS])
    operators().connect()

    (warning,) = [line for line in caplog.messages if "another DDS" in line]
    assert "another DDS: cam (/cam/image) from " in warning
    assert " (Cyclone DDS). When " in warning
    assert "fastdds_large_frames.xml" in warning


def test_images_from_the_same_dds_are_none(drivers, operators, caplog):
    drivers([STATE, CAMERA], [COMMANDS])
    operators().connect()

    assert "another DDS" not in caplog.text


def test_best_effort_images_from_another_dds_are_none(drivers, operators, caplog, monkeypatch):
    monkeypatch.setattr(qos, "_vendor", lambda offer: b"\x01\x10")
    drivers([STATE, {**CAMERA, "best_effort": True}], [COMMANDS])
    operators().connect()

    assert "another DDS" not in caplog.text


def test_failing_leaves_nothing_behind(operators):
    before = threading.active_count()
    with pytest.raises(NotReady):
        operators(connect_timeout_s=0.2).connect()

    assert threading.active_count() == before


def test_stop_does_not_wait_for_a_connection_that_does_not_come(operators):
    def fails(call):
        with pytest.raises(NotReady):
            call()

    operator = operators(connect_timeout_s=4.0)
    connecting = threading.Thread(target=fails, args=[operator.connect])
    connecting.start()
    time.sleep(0.3)
    before = time.monotonic()
    operator.stop()

    assert time.monotonic() - before < 3.0
    assert connecting.is_alive()
    connecting.join(10.0)
    assert not connecting.is_alive()


@pytest.mark.parametrize(
    ("settings", "what"),
    [
        ({"sync_on": "luck"}, "sync_on is 'stamp' or 'receipt', got 'luck'"),
        ({"max_age_s": 0}, "max_age_s must be a positive number of seconds, got 0"),
        ({"connect_timeout_s": float("inf")}, "connect_timeout_s must be a positive number"),
    ],
)
def test_settings_are_checked_at_once(settings, what):
    with pytest.raises(ConfigError, match=what):
        Arm(**settings)


def test_before_connecting_there_is_nothing():
    for call in (Arm().get_frame, Arm().get_state, lambda: Arm().send_action(np.zeros(3))):
        with pytest.raises(NotReady, match="arm is not connected"):
            call()


@pytest.mark.parametrize("ending", ["close", "kill"])
def test_a_driver_that_left_and_comes_back(operators, drivers, ending):
    robot, arm = drivers([STATE, CAMERA], [COMMANDS]), operators()
    arm.connect()
    getattr(robot, ending)()
    error = frame_error(arm, "(/cam/image) is silent for ")
    # Who was killed is on the graph for another 20 s.
    assert ("the driver is gone: nobody publishes" in error.cause) == (ending == "close")

    drivers([STATE, CAMERA], [COMMANDS])
    wait_for(lambda: all(time.monotonic() - arm.newest(n).receipt < 0.2 for n in ("arm", "cam")))
    assert frames_of(arm)


def test_streams_without_stamps_are_matched_by_receipt(operators, drivers):
    drivers([{**STATE, "stamped": False}, {**CAMERA, "stamped": False}], [COMMANDS])
    operator = operators()
    operator.connect()

    assert frames_of(operator)


def test_a_side_stream_that_need_not_be_there_is_not_missed(drivers, operators, monkeypatch):
    streams = Arm.streams(Arm())
    side = StreamSpec("mode", "/mode", "std_msgs.msg:Bool", kind=AUXILIARY, required=False)
    monkeypatch.setattr(Arm, "streams", lambda self: [*streams, side])
    drivers([STATE, CAMERA], [COMMANDS])
    operator = operators()
    operator.connect()

    assert operator.newest("mode") is None
    assert set(operator.get_frame().stamps) == {"state", "cam"}
