"""Real-time scheduling of the thread that sends commands: priority, GIL, garbage collection.

Three things keep a Python thread from its deadline, and each has a means of its own:

* other Python threads, which hold the GIL for 5 ms unless they are asked to release it earlier
  (``sys.setswitchinterval``), and may hold it just when a deadline comes unless it was taken from
  them before (``hold_gil``, ``wait_until``);
* a full garbage collection, which stops all threads for as long as it takes to look at every
  object of every imported library (``gc.freeze`` takes those out);
* other processes, which may also preempt a thread that holds the GIL just then. Where the system
  allows it (``RLIMIT_RTPRIO``, or root), the thread gets a real-time priority, as ros2_control's
  controller manager takes one, and threads that often take the GIL for an instant come next
  (``raise_priority``); elsewhere nothing is changed. The kernel's own limit on
  real-time threads (``sched_rt_runtime_us``) stays in force.
"""

from __future__ import annotations

import ctypes
import gc
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache

GIL_SHARED_S = 0.0005
GIL_HELD_S = 0.01
"""After which other threads demand the GIL: longer than a command is made ready ahead, or the
thread that holds it would have to release it just at its deadline."""
PRIORITY = 50
"""Above the kernel's ordinary work, as ros2_control; threads of interrupts have the same."""
_TIMER_ABSTIME = 1  # of <time.h>
_LOCK_ALL_IN_USE = 1 | 2 | 4  # MCL_CURRENT, MCL_FUTURE and MCL_ONFAULT of <sys/mman.h>
_entered = 0  # blocks of ``real_time`` that are open
_next = PRIORITY - 1  # what ``raise_priority`` gives


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


def hold_gil() -> None:
    """Hold the GIL until ``share_gil`` or a sleep; only within ``real_time``."""
    if _entered:
        sys.setswitchinterval(GIL_HELD_S)


def share_gil() -> None:
    """Share the GIL with other threads, for short slices; only within ``real_time``."""
    if _entered:
        sys.setswitchinterval(GIL_SHARED_S)


@contextmanager
def shared_gil() -> Iterator[None]:
    """Context manager: as :func:`share_gil`, while the calling thread waits for another one.

    A thread that computes for long then gives the GIL back in time.
    """
    interval = sys.getswitchinterval()
    share_gil()
    try:
        yield
    finally:
        sys.setswitchinterval(interval)


@contextmanager
def short_gil_slices() -> Iterator[None]:
    """Context manager: every thread of this process holds the GIL for short slices only.

    For a process that commands nothing itself, and has to show in time that it runs.
    """
    interval = sys.getswitchinterval()
    sys.setswitchinterval(GIL_SHARED_S)
    try:
        yield
    finally:
        sys.setswitchinterval(interval)


def wait_until(deadline: float) -> None:
    """Sleep until ``deadline`` (monotonic, in seconds) without releasing the GIL; for milliseconds.

    A thread that wakes has to get the GIL first, and the thread that holds it may be preempted by
    other processes just then. Here the calling thread holds it throughout; other threads only run
    where they do not need it, as torch's do. Off Linux it is released as in any sleep.
    """
    sleep = _sleep_with_gil()
    if sleep is not None and time.monotonic() < deadline:
        seconds = int(deadline)
        until = _Timespec(seconds, int((deadline - seconds) * 1e9))
        sleep(time.CLOCK_MONOTONIC, _TIMER_ABSTIME, ctypes.byref(until), None)
    share_gil()
    # What is left where a signal ended it.
    left = deadline - time.monotonic()
    if left > 0.0:
        time.sleep(left)


@cache
def _sleep_with_gil() -> Callable[..., int] | None:
    """``clock_nanosleep`` of a Linux C library."""
    if sys.platform != "linux":
        return None
    try:
        # PyDLL, unlike CDLL and time.sleep, does not release the GIL around a call.
        found: Callable[..., int] = ctypes.PyDLL(None).clock_nanosleep
    except (OSError, AttributeError):
        return None
    return found


@contextmanager
def real_time() -> Iterator[bool]:
    """Prefer the calling thread until the block ends; yields whether it has a real-time priority.

    Threads and processes that are begun inside are ordinary ones.
    """
    global _entered
    interval = sys.getswitchinterval()
    _entered += 1
    share_gil()
    _sleep_with_gil()  # found now, not while an arm moves
    gc.collect()
    gc.freeze()
    before = _raise(PRIORITY)
    try:
        yield before is not None
    finally:
        _restore(before)
        gc.unfreeze()
        _entered -= 1
        sys.setswitchinterval(interval)


def lock_memory() -> bool:
    """Lock the process's memory in RAM (``mlockall``); returns whether it is permitted.

    Pages are locked once they are in use: a thread's stack is mostly never used.
    """
    if sys.platform != "linux":
        return False
    import resource  # not on every system

    try:
        locks = ctypes.CDLL(None, use_errno=True).mlockall
        unlimited = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
    except (OSError, AttributeError):
        return False
    # Within a limit, what is allocated later would fail.
    return (unlimited or os.geteuid() == 0) and locks(_LOCK_ALL_IN_USE) == 0


def raise_priority() -> bool:
    """Raise the calling thread's priority to just below ``real_time``'s; whether it is permitted.

    For a thread that never computes for long, such as one that only stores what arrives.
    """
    return _raise(_next) is not None


def yield_to_control_process() -> None:
    """Let ``raise_priority`` give less from now on: another process commands the robot.

    Threads of the same real-time priority do not take turns: one of this process that has much to
    do, such as with images, would keep out a thread of the control process that holds its GIL.
    """
    global _next
    _next = PRIORITY - 2


@contextmanager
def normal_priority() -> Iterator[None]:
    """Context manager: undo ``raise_priority`` while the calling thread computes for long."""
    if sys.platform != "linux":
        yield
        return
    before = os.sched_getscheduler(0), os.sched_getparam(0).sched_priority
    raised = before[0] & ~os.SCHED_RESET_ON_FORK != os.SCHED_OTHER
    if raised:
        _restore((os.SCHED_OTHER, 0))
    try:
        yield
    finally:
        if raised:
            _restore(before)


def _restore(before: tuple[int, int] | None) -> None:
    if before is None:
        return
    policy, priority = before[0], os.sched_param(before[1])
    try:
        os.sched_setscheduler(0, policy, priority)
    except PermissionError:
        # Who is not root may lower a priority, but not take this mark away again (sched(7)).
        os.sched_setscheduler(0, policy | os.SCHED_RESET_ON_FORK, priority)


def _raise(priority: int) -> tuple[int, int] | None:
    """What the thread had before; None if nothing was changed."""
    if sys.platform != "linux":
        return None
    before = os.sched_getscheduler(0), os.sched_getparam(0).sched_priority
    if before[0] & ~os.SCHED_RESET_ON_FORK != os.SCHED_OTHER:
        return None  # somebody has seen to it already
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except PermissionError:
        return None
    return before
