"""No encoder may take the machine for itself."""

from __future__ import annotations

import os
import sys
import threading

import numpy as np
import pytest

from fluxvla_core.data.video_encode import CODECS, EpisodeEncoder, unchanged_scheduling

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="scheduling policies are Linux's")


def real_time():
    """Threads of this process, whoever began them, that go before all others."""
    threads = [int(tid) for tid in os.listdir("/proc/self/task")]
    return [t for t in threads if os.sched_getscheduler(t) in (os.SCHED_FIFO, os.SCHED_RR)]


@pytest.mark.parametrize("codec", CODECS)
def test_encoders_stay_ordinary(codec, tmp_path):
    """SVT-AV1 makes every thread of its own, and its caller, real-time ones where it may."""
    encoder = EpisodeEncoder(tmp_path / "x.mp4", 128, 128, 10.0, CODECS[codec])
    for value in range(12):
        encoder.add(np.full((128, 128, 3), value, np.uint8))
        assert real_time() == []
    encoder.close()
    assert real_time() == []


def test_what_changes_inside_is_put_back():
    ended = threading.Event()
    began: list[threading.Thread] = []
    with unchanged_scheduling():
        # Anybody may lower himself; SCHED_BATCH stands for a policy that somebody else chose.
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
        began.append(threading.Thread(target=ended.wait))
        began[0].start()
        assert os.sched_getscheduler(began[0].native_id) == os.SCHED_BATCH
    assert os.sched_getscheduler(began[0].native_id) == os.SCHED_OTHER
    assert os.sched_getscheduler(0) == os.SCHED_OTHER
    ended.set()
    began[0].join()


def test_a_policy_that_was_there_stays():
    before = os.sched_getscheduler(0)
    os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    try:
        with unchanged_scheduling():
            pass
        assert os.sched_getscheduler(0) == os.SCHED_BATCH
    finally:
        os.sched_setscheduler(0, before, os.sched_param(0))
