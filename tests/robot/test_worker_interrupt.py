"""The policy's thread, and signals."""

from __future__ import annotations

import os
import signal
import threading
import time

import pytest

from fluxvla_core.control.interrupt import Interrupted, Interrupts
from fluxvla_core.errors import RunFailed
from fluxvla_core.robot.local_policy_client import PolicyThread


def test_jobs_run_in_order_in_one_other_thread():
    worker = PolicyThread("thinker")
    futures = [worker.submit(lambda n=n: (n, threading.current_thread().name)) for n in range(3)]

    assert [f.result(5) for f in futures] == [(n, "thinker") for n in range(3)]
    assert worker.close(5)


def test_what_a_job_raises_is_raised_where_its_result_is_read():
    worker = PolicyThread("thinker")

    def job():
        raise KeyError("no such camera")

    with pytest.raises(KeyError, match="no such camera"):
        worker.submit(job).result(5)
    assert worker.submit(lambda: 1).result(5) == 1
    worker.close(5)


def test_a_job_that_hangs_does_not_hang_closing():
    worker = PolicyThread("thinker")
    worker.submit(lambda: time.sleep(1))

    assert not worker.close(0.05)


def test_a_worker_that_never_worked_closes():
    assert PolicyThread("thinker").close(0)


def send(number: int) -> None:
    os.kill(os.getpid(), number)
    time.sleep(0.01)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_deferred_signal_waits_for_the_next_look(number):
    with Interrupts() as interrupts:
        interrupts.check()
        interrupts.deferred = True
        send(number)

        with pytest.raises(Interrupted, match=number.name):
            interrupts.check()
        interrupts.check()


def test_elsewhere_a_signal_raises_on_the_spot():
    with Interrupts(), pytest.raises(Interrupted, match="SIGINT"):
        send(signal.SIGINT)


def test_a_second_signal_does_not_wait_where_no_beat_comes(monkeypatch):
    with Interrupts() as interrupts:
        interrupts.deferred = True
        send(signal.SIGTERM)
        monkeypatch.setattr("fluxvla_core.control.interrupt.IMPATIENT_S", 0.0)
        with pytest.raises(Interrupted, match="SIGINT"):
            send(signal.SIGINT)


def test_signals_that_come_together_cut_no_command_in_half(monkeypatch):
    monkeypatch.setattr("fluxvla_core.control.interrupt.IMPATIENT_S", 3600.0)
    with Interrupts() as interrupts:
        interrupts.deferred = True
        send(signal.SIGHUP)
        send(signal.SIGTERM)

        with pytest.raises(Interrupted, match="SIGHUP"):
            interrupts.check()


def test_while_stopping_signals_are_only_counted():
    with Interrupts() as interrupts:
        interrupts.stopping = True
        send(signal.SIGINT)
        send(signal.SIGTERM)
        interrupts.check()

        assert interrupts.signals == [signal.SIGINT, signal.SIGTERM]


def test_handlers_are_given_back():
    before = signal.getsignal(signal.SIGTERM)
    with Interrupts():
        assert signal.getsignal(signal.SIGTERM) is not before
    assert signal.getsignal(signal.SIGTERM) is before


def test_in_another_thread_signals_are_left_alone():
    before = signal.getsignal(signal.SIGINT)
    found = []

    def run():
        with Interrupts():
            found.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert found == [before]


def test_what_a_command_ends_with():
    assert isinstance(Interrupted(signal.SIGINT).final(), KeyboardInterrupt)
    ended = Interrupted(signal.SIGTERM).final()
    assert isinstance(ended, RunFailed)
    assert ended.exit_code == 1
    assert str(ended) == "stopped by SIGTERM; the robot was stopped"
    ended = Interrupted(signal.SIGINT).final("Arm.stop did not return within 5 s")
    failed = "stopped by Ctrl-C; stopping the robot failed: Arm.stop did not return within 5 s"
    assert str(ended) == failed
