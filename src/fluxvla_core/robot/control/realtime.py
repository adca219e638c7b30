"""Real-time scheduling of the thread that sends commands: priority, GIL, garbage collection.

Three things keep a Python thread from its deadline, and each has a means of its own:

* other threads of the interpreter, which keep it for 5 ms unless they are asked to give it up
  earlier (``sys.setswitchinterval``), and have it just when a deadline comes unless it was taken
  from them before (``keep_interpreter``, ``wait_until``);
* a full garbage collection, which stops all threads for as long as it takes to look at every
  object of every imported library (``gc.freeze`` takes those out);
* other processes, which may also stop a thread that has the interpreter just then. Where the system
  allows it (``RLIMIT_RTPRIO``, or root), the thread gets a real-time priority, as ros2_control's
  controller manager takes one, and those that take the interpreter often for an instant come next
  (``just_below_real_time``); elsewhere nothing is changed. The kernel's own limit on
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

SHARED_S = 0.0005
KEPT_S = 0.01
"""After which others demand the interpreter: longer than a command is made ready ahead, or the
thread that keeps it would have to give it up just when its deadline is there."""
PRIORITY = 50
"""Above the kernel's ordinary work, as ros2_control; threads of interrupts have the same."""
_TIMER_ABSTIME = 1  # of <time.h>
_LOCK_ALL_IN_USE = 1 | 2 | 4  # MCL_CURRENT, MCL_FUTURE and MCL_ONFAULT of <sys/mman.h>
_entered = 0  # blocks of ``real_time`` that are open


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


def keep_interpreter() -> None:
    """Keep the interpreter until ``share_interpreter`` or a sleep; only within ``real_time``."""
    if _entered:
        sys.setswitchinterval(KEPT_S)


def share_interpreter() -> None:
    """Let other threads have it, for short slices; only within ``real_time``."""
    if _entered:
        sys.setswitchinterval(SHARED_S)


@contextmanager
def shared_interpreter() -> Iterator[None]:
    """Let other threads have it while the calling one waits for one of them; as it was afterwards.

    One that computes for long then gives it back in time.
    """
    interval = sys.getswitchinterval()
    share_interpreter()
    try:
        yield
    finally:
        sys.setswitchinterval(interval)


@contextmanager
def short_slices() -> Iterator[None]:
    """Let every thread of this process have the interpreter for short slices until the block ends.

    For a process that commands nothing itself, and has to show in time that it runs.
    """
    interval = sys.getswitchinterval()
    sys.setswitchinterval(SHARED_S)
    try:
        yield
    finally:
        sys.setswitchinterval(interval)


def wait_until(deadline: float) -> None:
    """Sleep until ``deadline`` (monotonic, in seconds) with the interpreter; for milliseconds.

    A thread that wakes has to get the interpreter first, and who has it may be stopped by other
    processes just then. This one has it by then; meanwhile others only compute outside of it, as
    torch's do. Off Linux it is given up as in any sleep.
    """
    sleep = _keeping_sleep()
    if sleep is not None and time.monotonic() < deadline:
        seconds = int(deadline)
        until = _Timespec(seconds, int((deadline - seconds) * 1e9))
        sleep(time.CLOCK_MONOTONIC, _TIMER_ABSTIME, ctypes.byref(until), None)
    share_interpreter()
    # What is left where a signal ended it.
    left = deadline - time.monotonic()
    if left > 0.0:
        time.sleep(left)


@cache
def _keeping_sleep() -> Callable[..., int] | None:
    """``clock_nanosleep`` of a Linux C library."""
    if sys.platform != "linux":
        return None
    try:
        # PyDLL, unlike CDLL and time.sleep, does not give the interpreter up around a call.
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
    share_interpreter()
    _keeping_sleep()  # found now, not while an arm moves
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
    """Keep the process's memory from being moved to disk, for good; whether it may.

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


def just_below_real_time() -> bool:
    """Give the calling thread the priority below ``real_time``, for good; whether it may.

    For one that never computes for long, such as one that only stores what arrives.
    """
    return _raise(PRIORITY - 1) is not None


@contextmanager
def normal() -> Iterator[None]:
    """Give up ``just_below_real_time`` while the calling thread computes for long."""
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
