"""Whoever sends commands goes first while a robot is driven, and is as before afterwards."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from fluxvla_core.control import realtime
from fluxvla_core.control.chunks import Chunk, check_beginning
from fluxvla_core.control.clock import Rate
from fluxvla_core.control.limits import CommandLimiter
from fluxvla_core.control.safety import SafetySettings
from fluxvla_core.control.tracking import TrackingWatch
from fluxvla_core.spec import EmbodimentSpec, Joint

on_linux = pytest.mark.skipif(
    sys.platform != "linux" or os.sched_getscheduler(0) != os.SCHED_OTHER,
    reason="needs Linux, and a thread that is an ordinary one",
)
as_root = pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() != 0, reason="needs root's right to scheduling"
)


def state():
    return sys.getswitchinterval(), gc.get_freeze_count(), os.sched_getscheduler(0)


def inside(code: str) -> list[str]:
    """What a process prints; its whole surroundings are its own."""
    begin = "import os, sys, gc; from fluxvla_core.control import realtime\n"
    done = subprocess.run([sys.executable, "-c", begin + code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@on_linux
def test_everything_is_as_before_afterwards_also_after_an_error():
    before = state()

    def fail() -> None:
        with realtime.real_time():
            assert sys.getswitchinterval() == pytest.approx(realtime.GIL_SHARED_S)
            assert gc.get_freeze_count() > 0
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert state() == before


@on_linux
def test_the_thread_has_a_real_time_priority_where_it_may_and_what_it_begins_has_not():
    seen = []
    with realtime.real_time() as real_time:
        mine = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
        thread = threading.Thread(target=lambda: seen.append(os.sched_getscheduler(0)))
        thread.start()
        thread.join()
        child = inside("print(os.sched_getscheduler(0))")

    assert mine == (os.SCHED_FIFO if real_time else os.SCHED_OTHER)
    assert seen == [os.SCHED_OTHER]
    assert child == [str(os.SCHED_OTHER)]


@pytest.fixture
def counted():
    """Counts on and on in a thread of its own."""
    count, over = [0], threading.Event()

    def work() -> None:
        while not over.is_set():
            count[0] += 1
            time.sleep(0)

    thread = threading.Thread(target=work)
    thread.start()
    yield count
    over.set()
    thread.join()


@on_linux
def test_no_other_thread_takes_the_interpreter_before_a_deadline(counted):
    interval = sys.getswitchinterval()
    sys.setswitchinterval(60.0)
    try:
        time.sleep(0.05)  # whoever waits with the old interval is done with it
        before, deadline = counted[0], time.monotonic() + 0.2
        realtime.wait_until(deadline)
        kept = counted[0] - before, time.monotonic() >= deadline
        time.sleep(0.05)
        given = counted[0] - before
    finally:
        sys.setswitchinterval(interval)

    assert kept == (0, True)
    assert given > 0


@on_linux
def test_what_a_command_is_made_of_gives_the_interpreter_to_nobody(counted):
    """As numpy would for arrays of more than 500 numbers, such as chunks, and for ``argmax``."""
    joints = tuple(Joint(f"j{n}", "rad", -3.0, 3.0, 2.0, 20.0) for n in range(14))
    spec = EmbodimentSpec("arm", joints, (), 50.0)
    settings, limiter = SafetySettings(), CommandLimiter(spec, 0.02)
    watch = TrackingWatch(spec, settings)
    limiter.start(np.zeros(14))
    chunk = Chunk(np.full((200, 14), 0.1), 50.0, 0.0, np.zeros(14))
    interval = sys.getswitchinterval()
    sys.setswitchinterval(60.0)
    try:
        time.sleep(0.05)  # whoever waits with the old interval is done with it
        before = counted[0]
        for step in range(250):
            check_beginning(chunk.actions, spec, limiter.last, 50.0, settings)
            (command,), _ = limiter.run(chunk.at(step / 50)[None])
            watch.sent(command, step / 50)
            watch.check(command, step / 50)
        given = counted[0] - before
    finally:
        sys.setswitchinterval(interval)

    assert given == 0


@on_linux
@pytest.mark.alone  # another process on every core may stand in its place
@pytest.mark.realtime
def test_from_waking_to_its_command_a_thread_keeps_the_interpreter_and_then_shares_it(counted):
    with realtime.real_time():
        rate, kept, given = Rate(50, lead_s=0.004), [], []
        for _ in range(25):
            before = counted[0]
            rate.sleep()
            woke = counted[0]
            rate.wait()
            kept.append(counted[0] - woke)
            given.append(woke - before)

    # A machine that stands still meanwhile ends the time for which the interpreter is kept, and one
    # that is late leaves none to give.
    assert sorted(kept)[len(kept) // 2] == 0
    assert sorted(given)[len(given) // 2] > 0


@on_linux
def test_the_interpreter_is_kept_only_where_somebody_goes_first():
    before = sys.getswitchinterval()
    realtime.hold_gil()
    realtime.share_gil()
    assert sys.getswitchinterval() == before
    with realtime.real_time():
        realtime.hold_gil()
        assert sys.getswitchinterval() == pytest.approx(realtime.GIL_HELD_S)
        realtime.wait_until(time.monotonic())
        assert sys.getswitchinterval() == pytest.approx(realtime.GIL_SHARED_S)
        realtime.hold_gil()
    assert sys.getswitchinterval() == before


@on_linux
@as_root
def test_without_the_right_to_it_the_thread_stays_an_ordinary_one():
    printed = inside(
        "import resource; resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0)); os.setuid(65534)\n"
        "with realtime.real_time() as real_time: print(real_time, os.sched_getscheduler(0))"
    )

    assert printed == ["False", str(os.SCHED_OTHER)]


@on_linux
@as_root
def test_a_user_with_a_limit_gets_it_and_gives_it_back_again_and_again():
    printed = inside(
        "import resource\n"
        "try: resource.setrlimit(resource.RLIMIT_RTPRIO, (50, 50))\n"
        "except ValueError: sys.exit(print('refused'))\n"
        "os.setuid(65534)\n"
        "for _ in range(2):\n"
        "    with realtime.real_time() as real_time: print(real_time)\n"
        "print((os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK) == os.SCHED_OTHER)"
    )

    if printed == ["refused"]:
        pytest.skip("nobody may be given that limit here")
    assert printed == ["True", "True", "True"]


@on_linux
@as_root
def test_a_priority_that_somebody_chose_is_kept():
    printed = inside(
        "os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(7))\n"
        "with realtime.real_time() as changed:\n"
        "    print(changed, os.sched_getparam(0).sched_priority)\n"
        "print(os.sched_getscheduler(0) == os.SCHED_RR)"
    )

    assert printed == ["False", "7", "True"]


@on_linux
@as_root
def test_the_second_comes_right_behind_the_first():
    printed = inside(
        "import threading\n"
        "seen = []\n"
        "def work():\n"
        "    allowed = realtime.raise_priority()\n"
        "    seen.append((allowed, os.sched_getparam(0).sched_priority))\n"
        "with realtime.real_time():\n"
        "    thread = threading.Thread(target=work); thread.start(); thread.join()\n"
        "    print(*seen[0], os.sched_getparam(0).sched_priority)\n"
    )

    assert printed == ["True", "49", "50"]


@on_linux
@as_root
def test_the_control_process_s_threads_come_before_those_of_the_main_process():
    printed = inside(
        "def show(): print(os.sched_getparam(0).sched_priority)\n"
        "realtime.yield_to_control_process(); realtime.raise_priority(); show()"
    )

    assert printed == ["48"]


@on_linux
@as_root
def test_the_second_is_an_ordinary_one_while_it_computes_for_long():
    printed = inside(
        "def show(): print(os.sched_getparam(0).sched_priority)\n"
        "with realtime.normal_priority(): show()\n"
        "realtime.raise_priority(); show()\n"
        "with realtime.normal_priority(): show()\n"
        "show()"
    )

    assert printed == ["0", "49", "0", "49"]
