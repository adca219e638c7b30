"""Rings: bounded, in order, honest about repeats, overtaken messages and clocks that step."""

from __future__ import annotations

import itertools
import threading
from types import SimpleNamespace

import pytest

from fluxvla_core.ros2.messages import stamp_of
from fluxvla_core.ros2.streams import Received, Ring


def fed(stamps, depth=8, period=0.1):
    """A ring that got one message every ``period`` seconds, stamped as given."""
    ring = Ring(depth)
    kept = [ring.add(i * period, stamp, i) for i, stamp in enumerate(stamps)]
    return ring, kept


def test_the_newest_few_are_kept():
    ring, _ = fed([1.0, 1.1, 1.2, 1.3], depth=2)

    assert [m.message for m in ring.items()] == [2, 3]
    assert ring.newest() == Received(pytest.approx(0.3), 1.3, 3)
    assert ring.received == 4


def test_an_empty_ring_has_no_newest():
    assert Ring(1).newest() is None
    assert Ring(1).items() == ()


def test_a_ring_holds_at_least_one():
    with pytest.raises(ValueError, match="at least 1 message, got depth 0"):
        Ring(0)


def test_a_repeated_image_is_no_news_however_long_it_is_repeated():
    ring, kept = fed([5.0] + [5.1] * 40)

    assert kept == [True, True] + [False] * 39
    assert ring.newest().receipt == pytest.approx(0.1)
    assert (ring.duplicates, ring.clock_steps) == (39, 0)


def test_after_a_long_freeze_the_stream_goes_on():
    ring, kept = fed([5.0] * 30 + [8.0, 8.1])

    assert kept[-2:] == [True, True]
    assert ring.newest().message == 31


def test_overtaken_messages_are_dropped():
    ring, kept = fed([1.0, 1.2, 1.1, 1.3])

    assert kept == [True, True, False, True]
    assert [m.message for m in ring.items()] == [0, 1, 3]
    assert ring.overtaken == 1


@pytest.mark.parametrize("step", [-3600.0, 3600.0])
def test_a_clock_step_begins_anew(step):
    ring, kept = fed([100.0, 100.1, 100.2 + step, 100.3 + step])

    assert all(kept)
    assert [m.message for m in ring.items()] == [2, 3]
    assert ring.clock_steps == 1
    assert ring.stepped_at == pytest.approx(0.2)


def test_a_pause_is_no_step():
    ring = Ring(8)
    ring.add(0.0, 100.0, "before")
    ring.add(60.0, 160.0, "after")

    assert ring.clock_steps == 0
    assert len(ring.items()) == 2


def test_messages_without_stamps_are_kept_as_they_come():
    ring, kept = fed([None, None, None])

    assert kept == [True] * 3
    assert ring.duplicates == 0


def test_adding_and_reading_from_two_threads():
    ring = Ring(64)
    done = threading.Event()
    broken = []

    def read():
        while not done.is_set():
            items = ring.items()
            if any(a.message >= b.message for a, b in itertools.pairwise(items)):
                broken.append(items)

    reader = threading.Thread(target=read)
    reader.start()
    for i in range(20_000):
        ring.add(i * 0.001, i * 0.001, i)
    done.set()
    reader.join()

    assert broken == []
    assert ring.newest().message == 19_999


@pytest.mark.parametrize(
    ("header", "stamp"),
    [((12, 500_000_000), 12.5), ((0, 1), 1e-9), ((0, 0), None)],
)
def test_stamps_are_seconds_and_zero_is_none(header, stamp):
    sec, nanosec = header
    message = SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec))
    )

    assert stamp_of(message) == stamp


def test_a_message_without_a_header_has_no_stamp():
    assert stamp_of(SimpleNamespace(data=1.0)) is None
