"""Streams and their publishers, which are processes of their own here."""

from __future__ import annotations

import time
from importlib import metadata, util

import pytest

from fluxvla_core.ros2 import COMPRESSED_IMAGE, IMAGE, Connection, camera_stream, message_class
from fluxvla_core.ros2.startup import ReceptionStats, is_trap, large_frames_profile
from fluxvla_core.spec import Camera

CAMERA = {"topic": "/cam", "message": IMAGE, "hz": 30, "height": 480, "width": 640}


def wait_for(condition, seconds=30.0):
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, "did not happen in time"
        time.sleep(0.01)


@pytest.fixture
def camera(ros_domain):
    connection = Connection("viewer")
    yield connection.subscribe("cam", "/cam", message_class(IMAGE), depth=4)
    connection.close()


def count(stream, seconds):
    before, lost = stream.ring.received, stream.lost
    time.sleep(seconds)
    return stream.ring.received - before, stream.lost - lost


def test_reliable_is_taken_where_it_is_offered_and_nothing_is_lost(camera, drivers):
    # So slow that the queue of ten outlasts the seconds for which a busy machine may stop us.
    drivers([{**CAMERA, "hz": 5}])
    wait_for(camera.newest)
    lost = camera.lost
    wait_for(lambda: camera.ring.received >= 8)

    assert camera.reliability == "reliable"
    assert camera.lost == lost
    assert len(camera.ring.items()) == 4


def test_the_shared_memory_trap_is_real_and_counted(camera, drivers):
    """If this fails because all arrive, Fast DDS was mended and ``ReceptionStats`` can go."""
    drivers([{**CAMERA, "height": 1536, "width": 2048, "best_effort": True}])
    wait_for(lambda: camera.lost > 0)
    received, lost = count(camera, 1.0)
    stats = ReceptionStats("cam", camera.reliability, 1.0, received, lost, 0)

    assert camera.reliability == "best_effort"
    assert is_trap(stats)


@pytest.mark.skipif(
    (metadata.version("rclpy") if util.find_spec("rclpy") else "").startswith("7."),
    reason="Jazzy overrides a profile's transports while discovery is limited to this machine",
)
def test_the_profile_in_the_publisher_springs_the_trap(camera, drivers, monkeypatch):
    monkeypatch.setenv("FASTDDS_DEFAULT_PROFILES_FILE", large_frames_profile())
    drivers([{**CAMERA, "best_effort": True}])
    wait_for(camera.newest)
    received, lost = camera.ring.received, camera.lost
    wait_for(lambda: camera.ring.received >= received + 20)

    assert camera.reliability == "best_effort"
    assert camera.lost - lost <= 2


def test_a_driver_that_comes_back_with_other_settings_is_heard_again(camera, drivers):
    small = {**CAMERA, "height": 48, "width": 64}
    first = drivers([small])
    wait_for(lambda: camera.newest() and camera.reliability == "reliable")

    first.close()
    before = camera.ring.received
    drivers([{**small, "best_effort": True}])
    wait_for(lambda: camera.ring.received > before + 3)

    assert camera.reliability == "best_effort"


def test_latched_topics_give_their_last_message_to_who_comes_late(ros_domain, drivers):
    mode = {"topic": "/running", "message": "std_msgs.msg:Bool", "hz": 0, "data": True}
    drivers([{**mode, "latched": True}])
    time.sleep(0.2)
    connection = Connection("late")
    try:
        cls = message_class("std_msgs.msg:Bool")
        stream = connection.subscribe("running", "/running", cls, 1, latched=True)
        wait_for(stream.newest)
        assert stream.newest().message.data is True
    finally:
        connection.close()


@pytest.mark.parametrize(
    ("topic", "message"),
    [
        ("/c/image_raw", IMAGE),
        ("/c/image_raw/compressed", COMPRESSED_IMAGE),
        ("/c/depth/compressedDepth", COMPRESSED_IMAGE),
    ],
)
def test_a_topic_that_ends_in_compressed_is_compressed(topic, message):
    assert camera_stream(Camera("cam", 48, 64), topic).message == message


def test_a_depth_stream_has_a_name_of_its_own():
    stream = camera_stream(Camera("cam", 48, 64), "/d", depth=True)

    assert (stream.name, stream.kind, stream.label) == ("cam_depth", "depth", "cam_depth (/d)")
