"""A job of two machines, both of which are this one, that loses one of its agents for good."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from .jobs import CONFIG, PLUGIN, gone, kill, tree

pytest.importorskip("torch")
pytestmark = pytest.mark.slow

STEPS = ("--set", "runner.max_steps=90", "--set", "runner.save_iter_interval=30")
RUN = ("-m", "fluxvla_core", "run", "--config", "tiny_config.py", "--plugin", "tiny.py", *STEPS)
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo"}


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("tiny.py").write_text(PLUGIN)
    Path("tiny_config.py").write_text(CONFIG)


@contextmanager
def agents() -> Iterator[list[subprocess.Popen[bytes]]]:
    """A job of two, as ``srun torchrun`` starts it on two machines."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    torchrun = ["-m", "torch.distributed.run", "--nnodes", "2", "--nproc-per-node", "1"]
    torchrun += ["--max-restarts", "3", "--rdzv-id", "job", "--rdzv-backend", "c10d"]
    torchrun += ["--rdzv-endpoint", f"localhost:{port}", "--local-addr", "localhost"]
    words = [*torchrun, *RUN, "--work-dir", "work", "--resume", "auto"]
    started = []
    for _ in range(2):
        started.append(subprocess.Popen([sys.executable, *words], env=ENVIRONMENT))
        time.sleep(1.0)  # the first has the store
    try:
        yield started
    finally:
        for process in started:
            for pid in tree(process.pid) if process.poll() is None else []:
                kill(pid)
            process.wait()


def end_all_but(lost: subprocess.Popen[bytes], job: list[subprocess.Popen[bytes]]) -> None:
    """As ``srun --kill-on-bad-exit=1`` does when one of them has ended."""
    for process in job:
        if process is not lost:
            process.send_signal(signal.SIGTERM)
            assert process.wait(120) == 1


@pytest.mark.parametrize("which", [0, 1])
def test_a_job_that_lost_an_agent_is_ended_and_started_again_as_a_whole(which: int) -> None:
    from fluxvla_core.testing.training import differences

    whole = [sys.executable, *RUN, "--nproc", "2", "--work-dir", "whole"]
    subprocess.run(whole, env=ENVIRONMENT, check=True)
    saved = Path("work/checkpoints/step-000000030/manifest.json")
    with agents() as job:
        until = time.monotonic() + 300
        while not saved.exists():
            assert time.monotonic() < until
            time.sleep(0.02)
        left = tree(job[which].pid)
        job[which].kill()
        job[which].wait()
        end_all_but(job[which], job)
        assert gone(left)
    with agents() as job:
        assert [process.wait(300) for process in job] == [0, 0]
    assert differences(Path("whole"), Path("work")) == []
    shutil.rmtree("work")
