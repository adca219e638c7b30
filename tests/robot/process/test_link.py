"""``Link``: two ends in two processes, and the time since the other one ran."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from fluxvla_core.robot.process.link import TO_CONTROL_BYTES, Link, make_memory

OTHER = """
import os, sys, time
from fluxvla_core.robot.process.link import Link

link = Link(int(sys.argv[1]), control=True)
link.try_send("ready")
main = os.getppid()
while os.getppid() == main:
    link.mark_alive()
    while (message := link.receive()) is not None:
        if message.kind == "end":
            sys.exit()
        link.try_send(message.kind, message.arrays, **message.fields)
    time.sleep(0.001)
"""


@pytest.fixture
def memory():
    descriptor = make_memory()
    yield descriptor
    os.close(descriptor)


@pytest.fixture
def other(memory):
    """A process that sends back whatever it is sent."""
    link = Link(memory, control=False)
    command = [sys.executable, "-c", OTHER, str(memory)]
    with subprocess.Popen(command, pass_fds=(memory,)) as process:
        assert next_of(link).kind == "ready"
        yield link, process
        process.send_signal(signal.SIGCONT)
        link.try_send("end")
        assert process.wait(10) in (0, -signal.SIGKILL)


def next_of(link, within_s=20.0):
    return until(link.receive, within_s)


def until(found, within_s=20.0):
    deadline = time.monotonic() + within_s
    while (value := found()) in (None, False):
        assert time.monotonic() < deadline
        time.sleep(0.001)
    return value


def test_messages_go_there_and_back(other):
    link, _ = other
    arrays = (np.arange(6.0).reshape(2, 3), np.array([np.nan]))

    for number in range(200):
        assert link.try_send("echo", arrays, number=number, text="手")
        found = next_of(link)
        assert (found.kind, found.fields) == ("echo", {"number": number, "text": "手"})
        for got, wanted in zip(found.arrays, arrays, strict=True):
            np.testing.assert_array_equal(got, wanted)
    assert link.receive() is None
    assert link.lost == 0


def test_many_threads_send_and_nothing_is_mixed_up(other):
    link, _ = other

    def send(thread):
        for number in range(100):
            link.try_send(
                "echo", (np.full(thread + 1, float(number)),), thread=thread, number=number
            )

    threads = [threading.Thread(target=send, args=(n,)) for n in range(4)]
    for each in threads:
        each.start()
    found = [next_of(link) for _ in range(400)]
    for each in threads:
        each.join()

    for thread in range(4):
        own = [message for message in found if message["thread"] == thread]
        assert [message["number"] for message in own] == list(range(100))
        assert all((m.arrays[0] == m["number"]).all() for m in own)


def test_a_process_that_never_ran_is_not_silent(memory):
    link = Link(memory, control=False)
    link.mark_alive()
    time.sleep(0.02)

    assert link.silent_s() == 0.0


def test_a_process_that_is_stopped_is_silent_until_it_goes_on(other):
    link, process = other
    until(lambda: link.silent_s() < 0.1)

    # It may have been silent for a while before, as it gets no time of a busy machine.
    began, before = time.monotonic(), link.silent_s()
    process.send_signal(signal.SIGSTOP)
    until(lambda: link.silent_s() > 0.5)
    assert before + time.monotonic() - began >= 0.499
    assert link.try_send("echo", number=1)
    assert link.receive() is None
    process.send_signal(signal.SIGCONT)

    assert next_of(link)["number"] == 1
    until(lambda: link.silent_s() < 0.1)


def test_a_process_that_was_killed_is_silent_for_good(other):
    link, process = other

    process.kill()
    process.wait()

    before = link.silent_s()
    time.sleep(0.05)
    assert link.silent_s() >= before + 0.05


def test_each_end_has_its_own_time(memory):
    main, control = Link(memory, control=False), Link(memory, control=True)
    control.mark_alive()
    time.sleep(0.05)
    main.mark_alive()

    assert main.silent_s() >= 0.05
    assert control.silent_s() < main.silent_s()
    # To send something shows it as well.
    before = time.monotonic()
    control.try_send("x")
    silent = main.silent_s()
    assert silent <= time.monotonic() - before + 0.001


def test_what_finds_no_room_is_lost_and_counted_at_the_other_end(memory):
    main, control = Link(memory, control=False), Link(memory, control=True)
    large = np.zeros(TO_CONTROL_BYTES // 8 // 4)

    sent = [main.try_send("chunk", (large,), number=n) for n in range(5)]

    assert sent == [True, True, True, False, False]
    assert (control.lost, main.lost) == (2, 0)
    assert [control.receive()["number"] for _ in range(3)] == [0, 1, 2]
    assert control.receive() is None
    assert main.try_send("chunk", (large,), number=5)
    assert control.receive()["number"] == 5


def test_what_must_arrive_waits_for_room_and_keeps_its_order(memory):
    main, control = Link(memory, control=False), Link(memory, control=True)
    large = np.zeros(TO_CONTROL_BYTES // 8 // 4)

    for number in range(7):
        main.send("order", (large,), number=number)
    got = []
    for _ in range(10):
        while (message := control.receive()) is not None:
            got.append(message["number"])
        main.flush()

    assert got == list(range(7))
