"""Matching streams in time, with bounds on age and skew."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fluxvla_core.ros2 import Stale
from fluxvla_core.ros2.streams import Received
from fluxvla_core.ros2.sync import check_age, check_together, match, silent


def stream(*stamps, latency=0.0, clock=0.0):
    """Messages taken at ``stamps``, arriving ``latency`` later, stamped by a clock that is off."""
    return [Received(t + latency, t + clock, t) for t in stamps]


def taken(matched):
    return {name: received.message for name, received in matched.messages.items()}


def test_the_newest_instant_that_all_have_reached():
    streams = {
        "cam": stream(0.90, 0.93, 0.96, latency=0.06),
        "state": stream(*[i / 100 for i in range(80, 102)]),
    }

    matched = match(streams, max_skew=0.01)

    assert taken(matched) == {"cam": 0.96, "state": 0.96}
    assert matched.skew < 1e-9


def test_the_nearest_message_is_taken():
    matched = match({"a": stream(1.0, 1.1), "b": stream(0.98, 1.04, 1.2)}, max_skew=0.1)

    assert taken(matched) == {"a": 1.1, "b": 1.04}
    assert matched.skew == pytest.approx(0.06)


def test_too_far_apart_is_refused_with_the_stream_that_is_late():
    streams = {"cam": stream(0.5, latency=0.45), "state": stream(0.95, 1.0)}

    with pytest.raises(Stale) as caught:
        match(streams, max_skew=0.1)

    assert str(caught.value) == (
        "cam is 0.450 s behind state; at most 0.1 s is allowed\n"
        "  likely cause: cam is late, or comes in bursts\n"
        "  next: look at its driver's load, or allow more with max_skew_s of the operator"
    )


def test_clocks_that_differ_are_named_as_such_and_receipt_mends_it():
    streams = {"cam": stream(1.0, clock=-3600.0), "state": stream(1.0)}

    with pytest.raises(Stale, match=r"cam is 3600\.000 s behind state") as caught:
        match(streams, max_skew=0.1)

    assert caught.value.cause == "they arrive together, so the clocks that stamp them differ"
    assert "sync_on='receipt'" in caught.value.next
    assert match(streams, max_skew=0.1, by="receipt").skew == 0.0


@pytest.mark.parametrize(
    ("clock", "cause"),
    [
        (-10.0, "the clock that stamps cam is 10.03 s behind this machine's, or its messages are"),
        (10.0, "the clock that stamps cam is 9.97 s ahead of this machine's"),
    ],
)
def test_the_clock_that_is_off_is_named_however_many_messages_are_kept(clock, cause):
    """The state's ring reaches back for seconds, and what is nearest in it is old."""
    streams = {
        "cam": stream(99.9, 99.93, 99.96, latency=0.03, clock=clock),
        "state": stream(*[97.44 + i / 50 for i in range(128)]),
    }

    with pytest.raises(Stale) as caught:
        match(streams, max_skew=0.1, wall_offset=0.0)

    assert caught.value.cause.startswith(cause)
    assert "synchronise the machines' clocks" in caught.value.next


def test_a_camera_that_is_late_is_no_matter_of_clocks():
    streams = {"cam": stream(99.3, latency=0.7), "state": stream(99.9, 99.95, 100.0)}

    with pytest.raises(Stale) as caught:
        match(streams, max_skew=0.1, wall_offset=0.0)

    assert caught.value.cause == "cam is late, or comes in bursts"


def test_two_arms_that_are_stamped_apart_are_no_one_state():
    together = [99.8, 99.9, 100.0]
    left, right = stream(*together, latency=0.01), stream(*together, latency=0.02)
    check_together({"left": left, "right": right}, max_skew=0.1, wall_offset=0.0)

    off = stream(*together, latency=0.01, clock=-0.2)
    with pytest.raises(Stale) as caught:
        check_together({"left": off, "right": right}, max_skew=0.1, wall_offset=0.0)

    assert caught.value.what == (
        "left is stamped 0.190 s earlier than right, although they arrive together; "
        "at most 0.1 s is allowed"
    )
    assert caught.value.cause.startswith("the clock that stamps left is 0.21 s behind this mach")
    check_together({"left": off, "right": right}, max_skew=0.3, wall_offset=0.0)


def test_a_state_that_comes_in_bursts_or_without_stamps_is_together():
    burst = [Received(100.0, stamp, stamp) for stamp in (99.8, 99.9, 100.0)]
    bare = [Received(100.0, None, "x")]

    check_together({"left": burst, "right": stream(100.0)}, max_skew=0.1)
    check_together({"left": stream(50.0), "right": bare}, max_skew=0.1)


def test_one_stream_without_stamps_makes_receipts_count():
    streams = {"cam": stream(1.0, latency=0.01, clock=500.0), "float": [Received(1.0, None, "x")]}

    assert match(streams, max_skew=0.05).skew == pytest.approx(0.01)


def test_messages_from_before_the_first_stamp_never_match():
    items = [Received(0.9, None, "bare"), Received(1.0, 1.0, "stamped")]

    assert taken(match({"a": items, "b": stream(1.0)}, max_skew=0.1))["a"] == "stamped"


def test_silent_streams_are_those_whose_newest_is_old_or_missing():
    newest = {"cam": stream(1.0)[-1], "state": stream(1.9)[-1], "base": None}

    assert silent(newest, now=2.0, max_age=0.5) == {"cam": 1.0, "base": None}


def test_messages_that_belong_together_may_still_be_too_old():
    streams = {
        "cam": stream(0.3, latency=0.7),
        "state": stream(*[i / 100 for i in range(100)]),
    }
    matched = match(streams, max_skew=0.01)
    check_age(matched, now=1.0, max_age=0.8)

    with pytest.raises(Stale) as caught:
        check_age(matched, now=1.0, max_age=0.5)
    assert caught.value.what == (
        "cam is late: what belongs to its newest message arrived 0.70 s ago; 0.5 s is allowed"
    )


times = st.lists(st.integers(0, 2000), min_size=1, max_size=30, unique=True).map(
    lambda ticks: sorted(t / 1000 for t in ticks)
)


@given(st.dictionaries(st.sampled_from("abcd"), times, min_size=1))
def test_no_other_choice_is_nearer_to_the_instant(instants):
    streams = {name: stream(*values) for name, values in instants.items()}
    matched = match(streams, max_skew=10.0)
    instant = min(values[-1] for values in instants.values())

    for name, values in instants.items():
        best = min(abs(t - instant) for t in values)
        assert abs(matched.messages[name].stamp - instant) == pytest.approx(best)
    chosen = [m.stamp for m in matched.messages.values()]
    assert matched.skew == pytest.approx(max(chosen) - min(chosen))


@given(times, times)
def test_as_messages_arrive_nothing_goes_back(cam, state):
    """The gate of the control loop refuses a stream whose stamps run backwards."""
    before = {}
    for now in sorted({*cam, *state}):
        streams = {
            "cam": stream(*[t for t in cam if t <= now][-4:]),
            "state": stream(*[t for t in state if t <= now]),
        }
        if not all(streams.values()):
            continue
        for name, received in match(streams, max_skew=10.0).messages.items():
            assert received.receipt >= before.get(name, 0.0)
            before[name] = received.receipt
