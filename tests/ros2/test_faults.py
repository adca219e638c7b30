"""Faults on purpose."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest

from fluxvla_core.errors import UsageError
from fluxvla_core.ros2 import Fault, Faults, Outbox


def message(number, sec=10, nanosec=500_000_000):
    stamp = SimpleNamespace(sec=sec, nanosec=nanosec)
    return SimpleNamespace(
        number=number, position=[1.0, 2.0], data=0.5, header=SimpleNamespace(stamp=stamp)
    )


def numbers(faults, count):
    """Numbers of the messages that come out for messages 1 to ``count``, in order."""
    return [m.number for i in range(1, count + 1) for _, m in faults.apply("s", message(i))]


def ill(text):
    faults = Faults()
    faults.set(*Fault.parse(text))
    return faults


def test_a_well_stream_passes():
    assert numbers(Faults(), 3) == [1, 2, 3]


def test_freeze_repeats_the_last_message_from_before():
    faults = Faults()
    faults.apply("s", message(7))
    faults.set("s", Fault("freeze"))

    assert numbers(faults, 3) == [7, 7, 7]
    faults.clear("s")
    assert numbers(faults, 1) == [1]


@pytest.mark.parametrize(("text", "sent"), [("s=drop", []), ("s=drop:0.5", [1, 3, 5, 7])])
def test_drop(text, sent):
    assert numbers(ill(text), 8) == sent


def test_delay():
    assert [d for d, _ in ill("s=delay:0.2").apply("s", message(1))] == [0.2]


def test_duplicate_and_out_of_order():
    assert numbers(ill("s=duplicate"), 2) == [1, 1, 2, 2]
    assert numbers(ill("s=out_of_order"), 4) == [2, 1, 4, 3]


def test_nan_leaves_the_original_alone():
    original = message(1)
    ((_, sent),) = ill("s=nan").apply("s", original)

    assert all(math.isnan(v) for v in [*sent.position, sent.data])
    assert original.position == [1.0, 2.0]


def test_a_clock_step_moves_stamps_only():
    ((_, sent),) = ill("s=clock:-2.5").apply("s", message(1))

    assert (sent.header.stamp.sec, sent.header.stamp.nanosec) == (8, 0)
    assert sent.position == [1.0, 2.0]


def test_other_streams_are_well():
    assert [m.number for _, m in ill("x=drop").apply("s", message(1))] == [1]


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("s=drop:0", "the share that is dropped is above 0 and at most 1"),
        ("s=drop:1.5", "the share that is dropped is above 0 and at most 1"),
        ("s=delay:-1", "a delay is a positive number of seconds"),
        ("s=freeze:2", "freeze takes no amount; drop, delay, clock do"),
    ],
)
def test_an_amount_that_means_nothing_is_refused(text, what):
    with pytest.raises(UsageError, match=what):
        Fault.parse(text)


class Publisher:
    def __init__(self):
        self.sent = []

    def publish(self, message):
        self.sent.append(message.number)


def test_an_outbox_sends_what_is_due_in_the_order_of_time():
    faults, publisher = Faults(), Publisher()
    outbox = Outbox(faults)
    faults.set("late", Fault("delay", 1.0))
    outbox.put("late", publisher, message(1), now=10.0)
    outbox.put("s", publisher, message(2), now=10.5)
    assert outbox.next_due == 10.5

    outbox.flush(10.5)
    assert publisher.sent == [2]
    outbox.flush(11.0)
    assert publisher.sent == [2, 1]
    assert outbox.next_due == math.inf


def test_an_outbox_can_be_emptied():
    outbox, publisher = Outbox(Faults()), Publisher()
    outbox.put("s", publisher, message(1), now=0.0)
    outbox.clear()
    outbox.flush(1.0)

    assert publisher.sent == []


@pytest.mark.parametrize("text", ["s", "s=broken", "=drop", "s=drop:x", "s=delay:nan"])
def test_what_is_no_fault_is_a_usage_error(text):
    with pytest.raises(UsageError, match="'" + text):
        Fault.parse(text)
