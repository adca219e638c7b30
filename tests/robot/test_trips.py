"""The latch, the tracking watch, and which chunks are no motion."""

from __future__ import annotations

import sys
import threading
from dataclasses import replace

import numpy as np
import pytest

from fluxvla_core.control.chunks import check_beginning, check_chunk
from fluxvla_core.control.safety import Latch, SafetySettings, Trip
from fluxvla_core.control.tracking import TrackingWatch, action_columns
from fluxvla_core.errors import SafetyStop
from fluxvla_core.spec import EmbodimentSpec, Joint

ARM = EmbodimentSpec(
    "arm",
    (
        Joint("turn", "rad", -3, 3, 2, 10),
        Joint("slide", "m", 0, 1, 0.5, 5, kind="prismatic"),
        Joint("jaw", "normalized", 0, 1, 2, 10, kind="gripper", open=1, closed=0),
    ),
    (),
    50,
)
SETTINGS = SafetySettings()


def test_a_latch_holds_with_its_first_reason_until_re_armed():
    latch = Latch(lambda: 7.5)
    latch.check()
    latch.trip("chunk", "first")
    latch.trip("tracking", SafetyStop("second", cause="c"))

    with pytest.raises(SafetyStop, match="stopped by rule chunk: first") as caught:
        latch.check()
    assert "then re-arm" in str(caught.value)
    assert latch.tripped == Trip("chunk", "first", 7.5)
    latch.rearm()
    latch.check()
    assert [trip.what for trip in latch.trips] == ["first", "second"]


def test_an_arm_that_stays_behind_trips_after_a_while():
    watch = TrackingWatch(ARM, SETTINGS)
    state = np.array([0.6, 0.5, 1.0])
    watch.sent(np.array([1.0, 0.5, 0.0]), 9.9)
    watch.check(state, 10.0)
    watch.check(state, 10.24)

    with pytest.raises(SafetyStop) as caught:
        watch.check(state, 10.25)
    assert caught.value.rule == "tracking"
    assert "turn is 0.4 away from its command for 0.25 s; 0.3 are allowed" in str(caught.value)


def test_an_old_state_does_not_say_that_the_arm_stays_behind():
    watch = TrackingWatch(ARM, SETTINGS)
    state = np.array([0.6, 0.5, 1.0])
    watch.sent(np.array([0.9, 0.5, 0.0]), 9.9)
    for tick in range(50):
        watch.sent(np.array([1.0 + tick / 20, 0.5, 0.0]), 10.0 + tick / 50)
        watch.check(state, 10.0)

    with pytest.raises(SafetyStop, match=r"turn is 1\.15 away from its command for 0\.30 s"):
        watch.check(state, 10.3)


def test_a_state_is_held_against_the_command_that_the_arm_had_then():
    watch = TrackingWatch(ARM, SETTINGS)
    speed, lag, latency = 1.6, 0.06, 0.15
    for tick in range(100):
        now = tick / 50
        watch.sent(np.array([speed * now, 0.5, 0.0]), now)
        seen = now - latency
        watch.check(np.array([max(0.0, speed * (seen - lag)), 0.5, 0.0]), seen)


def test_a_state_from_before_all_commands_says_nothing():
    watch = TrackingWatch(ARM, SETTINGS)
    watch.check(np.array([0.6, 0.5, 1.0]), 1.0)
    watch.sent(np.array([1.0, 0.5, 0.0]), 2.0)
    watch.check(np.array([0.0, 0.5, 1.0]), 1.5)


def test_catching_up_in_between_begins_the_time_anew():
    watch = TrackingWatch(ARM, SETTINGS)
    watch.sent(np.array([1.0, 0.5, 0.0]), 0.0)
    behind, there = np.array([0.6, 0.5, 0.0]), np.array([0.9, 0.5, 0.0])
    for now, state in [(0.0, behind), (0.2, there), (0.4, behind), (0.6, behind)]:
        watch.check(state, now)
    watch.reset()
    watch.check(behind, 0.7)


def test_commands_are_sent_by_another_thread_meanwhile():
    watch = TrackingWatch(ARM, SETTINGS)
    command = np.array([1.0, 0.5, 0.0])
    ended = threading.Event()

    def send():
        at = 0.0
        while not ended.is_set():
            at += 1.0
            watch.sent(command, at)

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    sender = threading.Thread(target=send)
    sender.start()
    try:
        for _ in range(2000):
            # All that are remembered are looked at: none is this old.
            watch.check(command, -1.0)
    finally:
        ended.set()
        sender.join()
        sys.setswitchinterval(interval)


def test_prismatic_joints_are_measured_in_metres_and_grippers_not_at_all():
    watch = TrackingWatch(ARM, SETTINGS)
    watch.sent(np.array([0.0, 0.5, 0.0]), 0.0)
    state = np.array([0.0, 0.46, 1.0])
    watch.check(state, 0.0)
    with pytest.raises(SafetyStop, match=r"slide is 0\.04 away"):
        watch.check(state, 1.0)


def test_joints_are_found_by_name_in_a_state_of_its_own():
    spec = replace(ARM, state_joints=(ARM.joints[2], ARM.joints[0], ARM.joints[1]))

    np.testing.assert_array_equal(action_columns(spec), [1, 2, 0])
    with pytest.raises(SafetyStop, match="the state of arm does not contain slide, jaw"):
        action_columns(replace(ARM, state_joints=(ARM.joints[0],)))


LAST = np.array([0.0, 0.5, 0.0])


def checked(rows, rate=10.0, settings=SETTINGS):
    actions = check_chunk(np.array(rows, dtype=float), ARM, rate, settings)
    check_beginning(actions, ARM, LAST, rate, settings)


def test_a_motion_passes_as_float64():
    chunk = check_chunk([[0, 0.5, 0], [0.2, 0.5, 1]], ARM, 10.0, SETTINGS)

    assert chunk.dtype == np.float64
    np.testing.assert_array_equal(chunk, [[0, 0.5, 0], [0.2, 0.5, 1]])


def test_what_is_only_too_fast_or_a_little_too_far_is_left_to_the_limits():
    checked([[1.0, 0.5, 0.0], [2.9, 0.5, -0.1], [3.2, 0.5, 0.0]])


def test_a_gripper_may_be_wanted_well_beyond_closed():
    checked([[0.0, 0.5, -0.9], [0.0, 0.5, 1.9]])


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([[2.5, 0.5, 0.0]], "action 0 wants turn to jump by 2.5; at full speed that takes 1.15"),
        ([[0, 0.05, 0], [0, 1.0, 0]], r"action 1 wants slide to jump by 0\.95"),
        ([[0, 1.3, 0]], r"action 0 wants slide at 1.3, far beyond its limits \[0, 1\] m"),
        ([[0, 0.5, -1.1]], r"action 0 wants jaw at -1\.1, far beyond"),
        ([[0, 0.5, 0], [0, np.nan, 0]], "not finite: action 1, slide is nan"),
        ([[0, 0.5]], r"has shape \(1, 2\); arm takes \(T, 3\)"),
    ],
)
def test_what_is_no_motion_stops(rows, message):
    with pytest.raises(SafetyStop, match=message) as caught:
        checked(rows)
    assert caught.value.rule == "chunk"


def test_thresholds_are_the_settings():
    strict = SafetySettings(jump_s=0.1, excess=0.01)
    with pytest.raises(SafetyStop, match="jump"):
        checked([[0.5, 0.5, 0.0]], settings=strict)
    with pytest.raises(SafetyStop, match="far beyond"):
        checked([[0.0, 0.5, -0.05]], settings=strict)


def test_numbers_of_other_kinds_are_taken_and_words_are_not():
    with pytest.raises(SafetyStop, match="the policy's chunk is no array of numbers"):
        check_chunk([["a", "b", "c"]], ARM, 10.0, SETTINGS)


def test_only_the_way_to_its_beginning_depends_on_where_the_arm_is():
    rows = np.array([[2.5, 0.5, 0.0], [2.5, 0.5, 0.0]])
    actions = check_chunk(rows, ARM, 10.0, SETTINGS)

    check_beginning(actions, ARM, rows[0], 10.0, SETTINGS)
    with pytest.raises(SafetyStop, match=r"action 0 wants turn to jump by 2\.5"):
        check_beginning(actions, ARM, LAST, 10.0, SETTINGS)
