"""Tests with deadlines are run again where the machine stood still, and only there."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tools.stalls import StallWatch

ROOT = Path(__file__).resolve().parents[2]
TESTS = """
import os, signal, time

import pytest
from conftest import STALLED

attempts = {"stalled": 0, "own": 0}


@pytest.mark.realtime
def test_that_the_machine_fails():
    attempts["stalled"] += 1
    if attempts["stalled"] == 1:
        # As if the machine stood still: the watching process does not run.
        os.kill(STALLED.watch.pid, signal.SIGSTOP)
        time.sleep(0.5)
        os.kill(STALLED.watch.pid, signal.SIGCONT)
        pytest.fail("too late")


@pytest.mark.realtime
def test_that_fails():
    STALLED.began = time.monotonic() + 1000  # whatever the machine does meanwhile
    attempts["own"] += 1
    assert attempts["own"] > 1


def test_without_deadlines():
    assert attempts == {"stalled": 2, "own": 1}
"""


@pytest.fixture
def watch():
    made = StallWatch()
    yield made
    made.close()


def test_a_stall_is_seen_where_it_was(watch):
    began = time.monotonic()
    until = began + 60.0
    while watch.longest_s(began) < 0.3:
        assert time.monotonic() < until, "no stall was seen"
        os.kill(watch.pid, signal.SIGSTOP)
        time.sleep(0.4)
        os.kill(watch.pid, signal.SIGCONT)

    assert watch.longest_s(time.monotonic() + 1000) == 0.0


def test_only_what_failed_in_a_stall_is_run_again(tmp_path):
    pytest.importorskip("pytest_rerunfailures")
    (tmp_path / "test_deadlines.py").write_text(TESTS)
    own = [sys.executable, "-m", "pytest", "-c", ROOT / "pyproject.toml", "--rootdir", ROOT]
    done = subprocess.run(
        [*own, "-p", "conftest", "-p", "no:cacheprovider", tmp_path],
        cwd=ROOT,
        env={k: v for k, v in os.environ.items() if not k.startswith("PYTEST_")},
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    assert "1 failed, 2 passed, 1 rerun" in done.stdout, done.stdout
    assert "run again, the machine stood still: " in done.stdout
    assert "::test_that_the_machine_fails" in done.stdout.partition("run again, ")[2]
