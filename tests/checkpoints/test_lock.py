"""One training at a time has a work dir, and nobody has one that has ended."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
from contextlib import closing

import pytest

from fluxvla_core.checkpoints import lock
from fluxvla_core.checkpoints.lock import LOCK, lock_work_dir
from fluxvla_core.errors import RunFailed, UsageError

OWNER = """
import os, sys, time
from contextlib import closing
from pathlib import Path
from fluxvla_core.checkpoints.lock import lock_work_dir
held = lock_work_dir(Path(sys.argv[1]), print)
worker = os.fork() if "worker" in sys.argv else 1
if worker:
    print(worker, flush=True)
time.sleep(120)
"""


def start(work_dir, *words):
    """Another process that owns ``work_dir``, and what it said."""
    process = subprocess.Popen(
        [sys.executable, "-c", OWNER, str(work_dir), *words], stdout=subprocess.PIPE, text=True
    )
    return process, process.stdout.readline().strip()


def end(process):
    process.kill()
    process.stdout.close()
    process.wait()


def test_a_second_one_is_told_who_has_it_until_that_one_is_gone(tmp_path, monkeypatch):
    process, _ = start(tmp_path)
    monkeypatch.setattr(lock, "PATIENCE_S", 0.0)
    try:
        with pytest.raises(UsageError) as caught:
            lock_work_dir(tmp_path, pytest.fail)
        said = json.loads((tmp_path / LOCK).read_text())
        assert said["pid"] == process.pid
        assert str(caught.value) == (
            f"{tmp_path} is in use by another training: process {process.pid} on {said['host']}, "
            f"since {said['since']}\n"
            "  likely cause: the same command was started twice, or processes of a run that was "
            "killed live on\n"
            f"  next: wait for it, end it (kill {process.pid}), or name another --work-dir; if its "
            f"machine is gone for good: rm {tmp_path}/{LOCK}"
        )
    finally:
        end(process)
    with closing(lock_work_dir(tmp_path, pytest.fail)):
        assert json.loads((tmp_path / LOCK).read_text())["pid"] == os.getpid()


def test_a_loader_worker_that_lives_on_does_not_keep_it(tmp_path):
    """A lock of flock would be inherited by the fork."""
    process, worker = start(tmp_path, "worker")
    end(process)
    try:
        os.kill(int(worker), 0)
        with closing(lock_work_dir(tmp_path, pytest.fail)) as mine:
            assert mine.held
    finally:
        os.kill(int(worker), signal.SIGKILL)


def in_use(work_dir):
    """Whether another process finds it taken."""
    code = (
        "import sys; from pathlib import Path; from fluxvla_core.checkpoints import lock\n"
        "lock.PATIENCE_S = 0.0; lock.lock_work_dir(Path(sys.argv[1]), print)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(work_dir)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0 or "is in use by another training" in done.stderr
    return done.returncode != 0


def test_a_claim_within_a_claim_ends_without_it(tmp_path):
    with closing(lock_work_dir(tmp_path, pytest.fail)) as outer:
        inner = lock_work_dir(tmp_path, pytest.fail)
        assert not inner.held
        inner.close()
        assert outer.held
        assert in_use(tmp_path)
    assert not in_use(tmp_path)


def test_a_claim_that_nobody_holds_any_more_is_none(tmp_path):
    lock_work_dir(tmp_path, pytest.fail)
    assert lock_work_dir(tmp_path, pytest.fail).held


def test_a_file_system_without_locks_is_said(tmp_path, monkeypatch):
    def refuse(file, how):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "lockf", refuse)
    said = []
    outer = lock_work_dir(tmp_path, said.append)
    inner = lock_work_dir(tmp_path, said.append)
    assert (outer.held, inner.held) == (False, False)
    assert said == [
        f"{tmp_path}/{LOCK} cannot be locked (No locks available): nothing keeps a second training "
        "out of this work dir"
    ]


@pytest.mark.parametrize("locks", [True, False])
@pytest.mark.parametrize("how", ["removed", "moved", "another is there", "a link leads elsewhere"])
def test_a_work_dir_that_was_taken_away_is_noticed(tmp_path, monkeypatch, how, locks):
    work, moved = tmp_path / "work", tmp_path / "moved"
    real = moved if how == "a link leads elsewhere" else work
    saved = real / "checkpoints/step-000000003"
    saved.mkdir(parents=True)
    (saved / "manifest.json").write_text("{}")
    if real is not work:
        work.symlink_to(real)
    if not locks:
        monkeypatch.setattr(fcntl, "lockf", no_locks)
    with (
        closing(lock_work_dir(work, lambda text: None)) as outer,
        closing(lock_work_dir(work, pytest.fail)) as mine,
    ):
        mine.check()
        if how == "removed":
            shutil.rmtree(work)
        elif how == "a link leads elsewhere":
            work.unlink()
        else:
            work.rename(moved)
        if how in ("another is there", "a link leads elsewhere"):
            work.mkdir()
        for held in (outer, mine):
            with pytest.raises(RunFailed, match=f"the work dir {work} was taken away") as caught:
                held.check()
    text = str(caught.value)
    if how == "removed":
        assert "likely cause: it was removed; what was saved there is gone with it\n" in text
    else:
        assert f"; the newest checkpoint is {moved}/checkpoints/step-000000003\n" in text
        assert f"--work-dir {moved} --resume auto" in text
        assert ("was left as it is" in text) == (how != "moved")


def test_a_lock_that_was_removed_lets_another_in_and_is_noticed(tmp_path):
    with closing(lock_work_dir(tmp_path, pytest.fail)) as mine:
        (tmp_path / LOCK).unlink()
        with pytest.raises(RunFailed, match=r"run\.lock in it was removed or replaced"):
            mine.check()


def test_a_server_that_does_not_answer_takes_nothing_away(tmp_path, monkeypatch):
    with closing(lock_work_dir(tmp_path, pytest.fail)) as mine:

        def times_out(path):
            raise OSError(errno.ETIMEDOUT, "Connection timed out")

        monkeypatch.setattr(os, "stat", times_out)
        mine.check()


def no_locks(*args):
    raise OSError(errno.ENOLCK, "No locks available")
