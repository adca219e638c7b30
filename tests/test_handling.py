"""Answering signals for a while."""

from __future__ import annotations

import os
import signal
import threading

from fluxvla_core.signals import handling, ignore


def test_a_handler_answers_while_it_is_entered_and_then_whoever_did_before():
    before = signal.getsignal(signal.SIGTERM)
    seen = []
    with handling(lambda number, frame: seen.append(number), signal.SIGTERM, signal.SIGUSR1):
        os.kill(os.getpid(), signal.SIGUSR1)
        os.kill(os.getpid(), signal.SIGTERM)
    assert seen == [signal.SIGUSR1, signal.SIGTERM]
    assert signal.getsignal(signal.SIGTERM) is before


def test_it_is_given_back_after_an_error_too():
    before = signal.getsignal(signal.SIGTERM)
    try:
        with handling(lambda number, frame: None, signal.SIGTERM):
            raise KeyError("x")
    except KeyError:
        assert signal.getsignal(signal.SIGTERM) is before


def test_another_thread_changes_nothing():
    found = []

    def run():
        with handling(lambda number, frame: None, signal.SIGTERM):
            found.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert found == [signal.getsignal(signal.SIGTERM)]


def test_what_is_ignored_meanwhile_stays_ignored():
    before = signal.getsignal(signal.SIGUSR1)
    seen = []
    try:
        with handling(lambda number, frame: seen.append(number), signal.SIGUSR1, signal.SIGUSR2):
            ignore([signal.SIGUSR1])
            os.kill(os.getpid(), signal.SIGUSR1)
            os.kill(os.getpid(), signal.SIGUSR2)
        os.kill(os.getpid(), signal.SIGUSR1)
        assert seen == [signal.SIGUSR2]
        assert signal.getsignal(signal.SIGUSR1) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGUSR1, before)
