from __future__ import annotations

import ctypes
import threading
import time

import pytest

from fluxvla_core.control.delays import MACHINE, POLICY, DelayMonitor, robot_call

FRAME = robot_call("Arm.get_frame()")


def take(delays, party, seconds):
    with delays.of(party):
        time.sleep(seconds)


def test_who_took_most_of_the_time_is_late():
    delays, since = DelayMonitor(), time.monotonic()
    assert delays.longest(since) == (POLICY, 0.0)
    take(delays, POLICY, 0.04)
    # However long a sleep is on this machine, the second is longer.
    spent = time.monotonic() - since
    with delays.of(FRAME):
        time.sleep(spent + 0.1)

    late, seconds = delays.longest(since)

    assert late == FRAME
    assert seconds >= 0.1


def test_what_was_before_does_not_count():
    delays = DelayMonitor()
    take(delays, FRAME, 0.1)
    since = time.monotonic()
    take(delays, POLICY, 0.02)

    assert delays.longest(since)[0] == POLICY


def test_a_call_in_another_thread_that_has_not_returned_counts():
    delays, since = DelayMonitor(), time.monotonic()
    hangs, go_on = threading.Event(), threading.Event()

    def hang():
        with delays.of(FRAME):
            hangs.set()
            go_on.wait(30)

    thread = threading.Thread(target=hang)
    thread.start()
    assert hangs.wait(30)
    take(delays, POLICY, 0.01)
    time.sleep(0.1)
    late, under_way = delays.longest(since)[0], delays.under_way()
    go_on.set()
    thread.join()

    assert (late, under_way) == (FRAME, ["Arm.get_frame()"])
    assert delays.under_way() == []


def test_a_call_that_raises_is_over():
    delays = DelayMonitor()
    with pytest.raises(OSError), delays.of(FRAME):
        raise OSError
    assert delays.under_way() == []


@pytest.mark.alone  # a second busy process may take its core
@pytest.mark.realtime
def test_a_process_that_is_busy_does_not_stand_still():
    """Neither gives up the interpreter; the second computes."""
    delays = DelayMonitor()
    with delays.watched(print, 10.0):
        time.sleep(0.1)
        since = time.monotonic()
        ctypes.PyDLL(None).usleep(500_000)
        assert delays.longest(since)[0] == MACHINE
        assert delays.stood_still(since) > 0.3

        time.sleep(0.2)
        since, computed, power = time.monotonic(), 0.0, 1 << 20
        with delays.of(POLICY):
            # By the processor's time: others may run meanwhile.
            while computed < 0.6:
                since, before = time.monotonic(), time.process_time()
                7**power
                computed = time.process_time() - before
                power *= 2
        assert delays.longest(since)[0] == POLICY
