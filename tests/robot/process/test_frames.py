"""Frames in shared memory: what is shown is what was read, and nobody waits in vain."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from fluxvla_core.contracts.frame import Frame, RobotFrame
from fluxvla_core.control.safety import BadFrame
from fluxvla_core.errors import FluxError, NotReady, Rejected
from fluxvla_core.robot.process.frames import (
    FrameChannel,
    FrameMessage,
    frame_bytes,
    frame_of,
    make_frame_memory,
    message_of_frame,
)
from fluxvla_core.robot.process.remote_operator import RemoteOperator
from fluxvla_core.spec import Camera, EmbodimentSpec, Joint

CAMERAS = (Camera("front", 48, 64), Camera("wrist", 30, 40))
SPEC = EmbodimentSpec("arm", (Joint("j", "rad", -1, 1, 2, 10),), CAMERAS, 50)
NAMES = SPEC.camera_names


def frame(seed=0, **changed):
    random = np.random.default_rng(seed)
    images = {c.name: random.integers(0, 256, (c.height, c.width, 3), np.uint8) for c in CAMERAS}
    fields = {
        "state": random.uniform(-1, 1, 1),
        "images": images,
        "stamps": {"state": 1.5, "front": 1.25, "wrist": 1.0},
        **changed,
    }
    return Frame(**fields)


@pytest.fixture
def ends():
    memory = make_frame_memory(frame_bytes(SPEC, NAMES))
    yield FrameChannel(memory), FrameChannel(memory)
    memory.close()


def through(ends, message):
    main, control = ends
    main.request()
    control.wait_for_request()
    control.answer(message)
    assert main.answered(10.0)
    return main.take()


def assert_same(found, wanted, names=NAMES):
    np.testing.assert_array_equal(found.state, wanted.state)
    assert set(found.images) == set(names)
    for name in names:
        np.testing.assert_array_equal(found.images[name], wanted.images[name])
        assert found.images[name].dtype == wanted.images[name].dtype
    assert found.stamps == wanted.stamps


def test_a_frame_arrives_in_fresh_arrays(ends):
    wanted = frame()

    first, second = (
        frame_of(through(ends, message_of_frame(wanted, NAMES, "a"))) for _ in range(2)
    )

    assert_same(first, wanted)
    assert first.images["front"].flags.writeable
    assert not np.shares_memory(first.images["front"], second.images["front"])
    assert not np.shares_memory(first.state, second.state)


def test_depth_and_base_arrive_where_there_are_any(ends):
    plain = frame()
    random = np.random.default_rng(1)
    depths = {c.name: random.uniform(0, 9, (c.height, c.width)) for c in CAMERAS}
    base = np.array([0.5, -0.25])
    wanted = RobotFrame(plain.state, plain.images, plain.stamps, depths, base)
    assert ends[1].fits(message_of_frame(wanted, NAMES, "a"))

    found = frame_of(through(ends, message_of_frame(wanted, NAMES, "a")))
    without = frame_of(through(ends, message_of_frame(plain, NAMES, "a")))

    assert_same(found, wanted)
    for name in NAMES:
        np.testing.assert_array_equal(found.depths[name], np.float32(depths[name]))
    np.testing.assert_array_equal(found.base, base)
    assert (without.depths, without.base) == ({}, None)


def test_only_the_cameras_that_are_looked_at_are_sent(ends):
    wanted = frame()

    assert_same(
        frame_of(through(ends, message_of_frame(wanted, ("wrist",), "a"))), wanted, ("wrist",)
    )


def test_an_image_that_has_not_come_yet_is_missing(ends):
    wanted = frame()
    images = {"front": None, "wrist": wanted.images["wrist"]}

    found = frame_of(through(ends, message_of_frame(frame(images=images), NAMES, "a")))

    assert_same(found, wanted, ("wrist",))


def test_images_that_are_views_and_states_that_are_lists(ends):
    wanted = frame()
    images = {
        name: np.ascontiguousarray(i[..., ::-1])[..., ::-1] for name, i in wanted.images.items()
    }
    assert not images["front"].flags.c_contiguous

    found = frame_of(
        through(
            ends, message_of_frame(frame(images=images, state=wanted.state.tolist()), NAMES, "a")
        )
    )

    assert_same(found, wanted)


@pytest.mark.parametrize(
    "changed",
    [
        {"stamps": {"state": np.float32(0.5), "front": float("nan"), "wrist": "late"}},
        {"state": np.array([np.nan])},
        {"images": {"front": np.zeros((8, 8), np.float32), "wrist": np.zeros((0, 3), np.uint8)}},
    ],
)
def test_what_is_wrong_with_a_frame_arrives_as_it_is(ends, changed):
    wanted = frame(**changed)

    found = frame_of(through(ends, message_of_frame(wanted, NAMES, "a")))

    np.testing.assert_array_equal(found.state, wanted.state)
    for name in NAMES:
        np.testing.assert_array_equal(found.images[name], wanted.images[name])
    for name, stamp in wanted.stamps.items():
        assert found.stamps[name] == (
            None if stamp == "late" else pytest.approx(stamp, nan_ok=True)
        )


@pytest.mark.parametrize("changed", [{"state": "here"}, {"images": {"front": object()}}])
def test_what_is_no_array_of_numbers_is_refused(changed):
    with pytest.raises(BadFrame, match="no array of numbers, but a"):
        message_of_frame(frame(**changed), NAMES, "Arm.get_frame()")


def test_an_image_that_is_too_large_does_not_fit(ends):
    larger = {"front": np.zeros((480, 640, 3), np.uint8)}

    assert ends[1].fits(message_of_frame(frame(), NAMES, "a"))
    assert not ends[1].fits(message_of_frame(frame(images=larger), NAMES, "a"))
    assert not ends[1].fits(FrameMessage({"text": "x" * 200_000}))


WITHOUT_ROOM = """
import resource
from fluxvla_core.robot.process.frames import make_frame_memory

resource.setrlimit(resource.RLIMIT_FSIZE, (2**20, 2**20))
make_frame_memory(2**19)
try:
    make_frame_memory(2**21)
except OSError:
    print("refused")
"""


def test_memory_that_is_not_there_is_an_error_at_once():
    """Not when it is used: that would be a crash, with the arm in motion."""
    command = [sys.executable, "-c", WITHOUT_ROOM]

    assert subprocess.check_output(command, text=True, timeout=60) == "refused\n"


OTHER = """
import sys
import numpy as np
from fluxvla_core.robot.process.frames import FrameChannel, FrameMemory, FrameMessage

channel = FrameChannel(FrameMemory(*map(int, sys.argv[1:])))
for number in range(200):
    channel.wait_for_request()
    channel.answer(FrameMessage({"number": number}, {"a": np.full((64, 48, 3), number, np.uint8)}))
"""


def test_every_answer_of_another_process_is_whole_and_new():
    memory = make_frame_memory(frame_bytes(SPEC, NAMES))
    channel = FrameChannel(memory)
    command = [sys.executable, "-c", OTHER, *map(str, memory)]
    with subprocess.Popen(command, pass_fds=memory) as process:
        for number in range(200):
            channel.request()
            until = time.monotonic() + 30
            while not channel.answered(0.05):
                assert time.monotonic() < until
            message = channel.take()
            assert message.fields["number"] == number
            assert (message.arrays["a"] == number).all()
        assert process.wait(30) == 0
    channel.close()


def answering(operator, looks):
    """The control process's end of ``operator``; its thread gives ``looks``."""
    memory = operator.open(NAMES)
    control = FrameChannel(type(memory)(*map(os.dup, memory)))

    def answer():
        for message in looks:
            control.wait_for_request()
            if message is not None:
                control.answer(message)

    thread = threading.Thread(target=answer, daemon=True)
    thread.start()
    return thread


def test_what_the_operator_raised_is_raised_here():
    operator = RemoteOperator("Arm", SPEC)
    error = {"error": ["NotReady"], "rule": NotReady.rule, "what": "no image yet"}
    answering(operator, [FrameMessage({"error": error}), message_of_frame(frame(), NAMES, "a")])

    with pytest.raises(NotReady, match="no image yet"):
        operator.get_frame()
    assert_same(operator.get_frame(), frame())
    operator.close()


def test_it_neither_commands_nor_stops_and_has_no_frames_without_a_process():
    operator = RemoteOperator("Arm", SPEC, 7)

    assert (operator.embodiment, operator.domain_id) == (SPEC, 7)
    with pytest.raises(NotReady, match="the control process does not run"):
        operator.get_frame()
    with pytest.raises(Rejected, match="Arm runs in the control process"):
        operator.send_action(np.zeros(1))
    operator.stop()
    operator.close()
    operator.close()


def test_who_waits_for_a_frame_gives_up_when_the_control_process_is_gone():
    operator, found = RemoteOperator("Arm", SPEC), []
    answering(operator, [None])

    def ask():
        try:
            operator.get_frame()
        except FluxError as error:
            found.append(error)

    thread = threading.Thread(target=ask)
    thread.start()
    time.sleep(0.2)
    assert thread.is_alive()
    began = time.monotonic()
    operator.close()

    thread.join(20)
    assert time.monotonic() - began < 5.0
    assert "does not run" in str(found)
    # The next process has memory of its own.
    answering(operator, [message_of_frame(frame(3), NAMES, "a")])
    assert_same(operator.get_frame(), frame(3))
    operator.close()
