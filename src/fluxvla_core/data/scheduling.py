"""Keep a library from raising its threads above everything else on the machine."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator

Scheduling = tuple[int, int]


@contextlib.contextmanager
def unchanged_scheduling() -> Iterator[None]:
    """Give threads back the scheduling they had, and those begun meanwhile that of the caller.

    SVT-AV1, where it may (as root, which containers on robots often are), makes the thread that
    opens an encoder and all of its own real-time ones of the highest priority, and processes
    started later inherit that: nothing else on the machine runs while they do, least of all
    whatever sends commands to an arm.
    Source: ``svt_av1_enc_init`` and ``svt_create_thread`` of SVT-AV1 (``SCHED_FIFO``, 99).
    """
    if sys.platform != "linux":
        yield
        return
    mine, before = _scheduling(0), {tid: _scheduling(tid) for tid in _threads()}
    try:
        yield
    finally:
        for tid in _threads():
            should = before.get(tid) or mine
            now = _scheduling(tid)
            if should is not None and now is not None and now != should:
                # Lowering needs no right; a thread that has just ended needs nothing.
                with contextlib.suppress(ProcessLookupError):
                    os.sched_setscheduler(tid, should[0], os.sched_param(should[1]))


def _threads() -> list[int]:
    return [int(name) for name in os.listdir("/proc/self/task")]


def _scheduling(tid: int) -> Scheduling | None:
    """Policy and priority; None for a thread that has ended."""
    try:
        return os.sched_getscheduler(tid), os.sched_getparam(tid).sched_priority
    except ProcessLookupError:
        return None
