"""``--nproc``: real ranks, their failures, signals, and a launcher that is killed."""

from __future__ import annotations

import errno
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from fluxvla_core.cli import launch, ranks
from fluxvla_core.cli.main import _end_reason
from fluxvla_core.cli.ranks import Failure, root_cause
from fluxvla_core.errors import RunFailed

from .conftest import Fluxvla, Write
from .test_run import said

COMMAND = [
    sys.executable,
    "-m",
    "fluxvla_core",
    "run",
    "--config",
    "c.py",
    "--plugin",
    "toy.py",
    "--section",
    "runner",
    "--nproc",
    "2",
]

torch = pytest.mark.skipif(
    __import__("importlib.util").util.find_spec("torch") is None, reason="ranks need torch"
)


TORCHRUN = [
    *(sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"),
    *("-m", *COMMAND[2:-2]),
]


def start(*words: str, command: Sequence[str] = COMMAND) -> subprocess.Popen[str]:
    environment = {k: v for k, v in os.environ.items() if k != "OMP_NUM_THREADS"}
    return subprocess.Popen(
        [*command, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )


def finished(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    out, err = process.communicate(timeout=60)
    return process.returncode, out, err


@torch
def test_two_ranks_train_and_one_talks(write: Write) -> None:
    code, out, err = finished(start("--set", "runner.max_epochs=5", "--resume", "auto"))
    assert (code, err) == (0, "")
    assert out.count("train 2/2") == 1
    cores = len(os.sched_getaffinity(0))
    for rank in (0, 1):
        told = said(rank=rank)
        assert (told["nproc"], told["world"], told["epochs"]) == (2, "2", 5)
        assert told["resume"] == "auto"
        assert told["threads"] == str(max(1, cores // 2))


@torch
@pytest.mark.parametrize(
    ("mode", "code", "text"),
    [
        ("rank 1 fails", 2, "rank-1.mp4: bad data\n"),
        ("rank 1 raises", 1, "rank 1 failed:\nTraceback"),
        (
            "rank 1 dies",
            1,
            "rank 1 ended without an error message: killed by SIGKILL\n"
            "  likely cause: this machine, or its container, ran out of memory (see dmesg), or "
            "somebody killed it\n"
            "  next: run the same command again with --resume auto\n",
        ),
    ],
)
def test_the_first_failure_is_the_message(write: Write, mode: str, code: int, text: str) -> None:
    ended, _, err = finished(start("--set", f"runner.mode+={mode}"))
    assert ended == code
    assert err.startswith(text)
    assert "SIGTERM" not in err


def waiting(process: subprocess.Popen[str]) -> list[int]:
    """The ranks' process ids, once both are at work."""
    files = [Path(f"work_dirs/c/pid-{rank}") for rank in (0, 1)]
    until = time.monotonic() + 60
    while not all(f.exists() and f.read_text() for f in files):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < until
        time.sleep(0.05)
    return [int(f.read_text()) for f in files]


@torch
@pytest.mark.parametrize(
    ("number", "code", "text"),
    [
        (
            signal.SIGINT,
            130,
            "interrupted: run the same command again with --resume auto\n",
        ),
        (signal.SIGTERM, 1, "stopped by SIGTERM\n"),
    ],
)
def test_signals_reach_the_ranks(write: Write, number: int, code: int, text: str) -> None:
    process = start("--set", "runner.mode+=wait")
    pids = waiting(process)
    process.send_signal(number)
    assert finished(process)[::2] == (code, text)
    assert not any(alive(pid) for pid in pids)


KILLED = """1 of 2 ranks were killed, or had not begun, when they were to stop and save
  likely cause: saving took longer than --grace 5 (seconds)
  next: {}: run the same command again with --resume auto
"""


@torch
@pytest.mark.parametrize(
    ("number", "code", "prefix", "left"),
    [
        (signal.SIGINT, 130, "interrupted: ", "the newest checkpoint is {}"),
        (signal.SIGTERM, 1, "", "there is no checkpoint yet"),
    ],
)
def test_ranks_that_must_be_killed_leave_word_of_what_there_is(
    write: Write, number: int, code: int, prefix: str, left: str
) -> None:
    saved = Path("work_dirs/c/checkpoints/step-000000003")
    if "{}" in left:
        saved.mkdir(parents=True)
        (saved / "manifest.json").write_text("{}")
    words = ("--set", "runner.mode+=wait, rank 1 deaf", "--grace", "5", "--resume", "auto")
    process = start(*words)
    pids = waiting(process)
    process.send_signal(number)
    assert finished(process)[::2] == (code, prefix + KILLED.format(left.format(saved)))
    assert not any(alive(pid) for pid in pids)


def test_grace_is_for_processes_that_are_started(run: Fluxvla) -> None:
    for words in (("--section", "eval", "--nproc", "2"), ("--section", "runner")):
        ended = run("--config", "c.py", *words, "--grace", "5")
        assert ended.code == 2
        assert "--grace is for the processes that --nproc or --max-restarts starts" in ended.err


@torch
@pytest.mark.parametrize("command", [COMMAND, TORCHRUN], ids=["nproc", "torchrun"])
def test_ranks_do_not_outlive_a_launcher_that_is_killed(
    write: Write, command: Sequence[str]
) -> None:
    Path("work_dirs/c").mkdir(parents=True)  # under torchrun the first rank makes it
    process = start("--set", "runner.mode+=wait", command=command)
    pids = waiting(process)
    process.kill()
    process.communicate()
    until = time.monotonic() + 20
    while any(alive(pid) for pid in pids):
        assert time.monotonic() < until
        time.sleep(0.05)


@torch
def test_the_same_command_started_twice_names_the_first_and_leaves_its_records(
    write: Write,
) -> None:
    first = start("--set", "runner.mode+=wait")
    rank = waiting(first)[0]
    config = Path("work_dirs/c/config.resolved.json").read_text()
    code, _, err = finished(start("--set", "runner.mode+=other"))
    first.kill()
    first.communicate()
    assert code == 2
    here = Path("work_dirs/c").resolve()
    assert err.startswith(f"{here} is in use by another training: process {rank} on ")
    assert Path("work_dirs/c/config.resolved.json").read_text() == config


def alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2][0]
    except OSError:  # ESRCH too, where it ends between opening and reading
        return False
    return state != "Z"


# -- in this process -------------------------------------------------------------------------


def test_nproc_inside_a_rank(run: Fluxvla, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    ended = run("--config", "c.py", "--section", "runner", "--nproc", "2")
    assert ended.code == 2
    assert "--nproc starts ranks, and this process is one already" in ended.err
    assert "leave --nproc out under torchrun" in ended.err


def test_nproc_without_torch(run: Fluxvla, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [n for n in sys.modules if n == "torch" or n.startswith("torch.distributed")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.setitem(sys.modules, "torch.distributed", None)
    ended = run("--config", "c.py", "--section", "runner", "--nproc", "2")
    assert ended.code == 2
    assert "which is not installed\n  next: pip install 'fluxvla-core[train]'" in ended.err


def test_only_rank_0_of_torchrun_talks_and_writes(
    run: Fluxvla, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RANK", "1")
    monkeypatch.setenv("WORLD_SIZE", "2")
    Path("work_dirs/c").mkdir(parents=True)
    ended = run("--config", "c.py", "--section", "runner")
    assert (ended.code, ended.out) == (0, "")
    assert said(rank=1)["nproc"] == 2
    assert not Path("work_dirs/c/config.resolved.json").exists()


def second_of_two(monkeypatch: pytest.MonkeyPatch, errors: Path) -> None:
    """Be a rank that ``--nproc 2`` launched."""
    monkeypatch.setenv("RANK", "1")
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv(ranks.ERROR_DIR, str(errors))
    monkeypatch.setattr(launch, "die_with_parent", lambda: None)
    Path("work_dirs/c").mkdir(parents=True)


def test_a_launched_rank_leaves_its_error_to_the_launcher(
    run: Fluxvla, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    second_of_two(monkeypatch, tmp_path)
    ended = run("--config", "c.py", "--section", "runner", "--set", "runner.mode+=denied")
    assert (ended.code, ended.err) == (2, "")
    failure = ranks.failures(tmp_path)[1]
    assert (failure.text, failure.code, failure.expected) == (
        "a.mp4: bad data\n  next: look at it",
        2,
        True,
    )
    monkeypatch.setenv(ranks.ERROR_DIR, str(tmp_path / "gone"))
    ended = run("--config", "c.py", "--section", "runner", "--set", "runner.mode+=denied")
    assert "a.mp4: bad data" in ended.err


def test_a_rank_that_failed_ignores_signals_while_it_reports(
    run: Fluxvla, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The agent asks all ranks to stop as soon as one has failed: also this one."""
    second_of_two(monkeypatch, tmp_path)
    record, numbers = ranks.record_failure, (signal.SIGINT, signal.SIGTERM)

    def signalled(*args: Any, **fields: Any) -> bool:
        for number in numbers:
            os.kill(os.getpid(), number)
        return record(*args, **fields)

    monkeypatch.setattr(ranks, "record_failure", signalled)
    ended = run("--config", "c.py", "--section", "runner", "--set", "runner.mode+=denied")
    assert (ended.code, ranks.failures(tmp_path)[1].text) == (
        2,
        "a.mp4: bad data\n  next: look at it",
    )
    assert [signal.getsignal(number) for number in numbers] == [signal.SIG_IGN] * 2


def test_a_process_without_an_agent_has_its_handlers_back_after_an_error(run: Fluxvla) -> None:
    before = signal.getsignal(signal.SIGTERM)
    ended = run("--config", "c.py", "--section", "runner", "--set", "runner.mode+=denied")
    assert (ended.code, signal.getsignal(signal.SIGTERM)) == (2, before)


def test_a_launched_rank_that_is_done_says_so(
    run: Fluxvla, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    second_of_two(monkeypatch, tmp_path)
    assert run("--config", "c.py", "--section", "runner").code == 0
    assert (ranks.finished(tmp_path), ranks.failures(tmp_path)) == ({1: 0}, {})


def test_a_signal_after_all_ranks_were_done_is_no_failure(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def ended(rank: str, attempt: str) -> None:
        monkeypatch.setenv("RANK", rank)
        monkeypatch.setenv("TORCHELASTIC_RESTART_COUNT", attempt)
        ranks.record_finished(signal.SIGTERM)

    monkeypatch.setenv(ranks.ERROR_DIR, str(tmp_path))
    assert ranks.record_failure("a.mp4: bad data", 2, expected=True)
    ended("0", "1")
    with pytest.raises(RunFailed, match=r"^1 of 2 ranks were killed"):
        launch._signalled(signal.SIGTERM, tmp_path, 2, tmp_path, 5)
    ended("1", "1")
    assert launch._signalled(signal.SIGTERM, tmp_path, 2, tmp_path, 5) == (0, signal.SIGTERM)


def test_a_record_that_a_full_disk_cut_off_hides_no_other(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv(ranks.ERROR_DIR, str(tmp_path))
    assert ranks.record_failure("a.mp4: bad data", 2, expected=True)

    def cut(path: Path, *args: object, **settings: object) -> None:
        path.touch()
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setenv("RANK", "1")
    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_text", cut)
        assert not ranks.record_failure("rank 1 says it on the terminal", 1, expected=True)
    assert [path.name for path in tmp_path.iterdir()] == ["rank-0.0.json"]
    (tmp_path / "rank-2.0.json").touch()
    assert list(ranks.failures(tmp_path)) == [0]


@torch
def test_a_full_disk_before_there_are_ranks(
    run: Fluxvla, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    command = ("--config", "c.py", "--section", "runner", "--nproc", "2")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "gone"))
    ended = run(*command)
    assert ended.code == 1
    assert ended.err.startswith("no temporary folder can be made for the ranks: No such file")

    def full(*args: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "ranks.log")

    monkeypatch.setattr(launch, "launch", full)
    ended = run(*command)
    assert ended.code == 1
    assert ended.err.startswith("no space left on the disk while writing ranks.log\n  next: make")


def test_a_rank_that_lost_another_is_no_cause(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv(ranks.ERROR_DIR, str(tmp_path))
    said = "rank 0 of 2 lost another rank during step 14\n  …"
    assert ranks.record_failure(said, 1, expected=True, reason="rank lost")
    (lost,) = ranks.failures(tmp_path).values()
    assert lost.asked
    killed = Failure(1, lost.time + 1, "ended without an error message", 1, silent=True)
    assert root_cause([lost, killed]) is killed


def test_why_a_run_ended_is_a_field() -> None:
    stopped = RunFailed("stopped by SIGTERM", next="go on", reason="stopped")
    sent = pickle.loads(pickle.dumps(stopped))  # noqa: S301 - of this very test
    assert (str(sent), sent.next, sent.reason) == (str(stopped), "go on", "stopped")
    assert _end_reason(stopped) == "stopped"
    assert _end_reason(RunFailed("the text stopped by SIGTERM alone says nothing")) is None
    closing = OSError("while closing")
    closing.__context__ = stopped
    assert _end_reason(closing) == "stopped"
    assert _end_reason(KeyboardInterrupt()) is None


def test_the_root_cause() -> None:
    asked = Failure(0, 1.0, "training was stopped by SIGTERM", 1, expected=True, asked=True)
    broken = Failure(1, 2.0, "RuntimeError: connection closed", 1)
    later = Failure(2, 2.5, "RuntimeError: connection closed", 1)
    killed = Failure(3, 3.0, "ended without an error message", 1, silent=True)
    named = Failure(4, 4.0, "a.mp4: bad data", 2, expected=True)
    assert root_cause([asked, broken, later, killed, named]) is named
    assert root_cause([asked, broken, later, killed]) is killed
    assert root_cause([asked, later, broken]) is broken
    assert root_cause([asked]) is asked


def test_a_rank_whose_launcher_is_gone_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    code = (
        "from fluxvla_core.cli import launch\n"
        "try:\n    launch.die_with_parent()\n"
        "except Exception as error:\n    print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, ranks.LAUNCHER: "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "the launcher of this rank has ended\n"


def test_a_rank_that_did_not_stop_after_anothers_failure_is_no_cause(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Process:
        exitcode = -9

    first = Failure(1, 100.0, "ValueError: boom", 1)
    monkeypatch.setattr(launch.time, "monotonic", lambda: 100.0 + launch._STOP_S)
    found = launch._all({0: Process(), 1: Process()}, {1: first})
    assert root_cause(found) is first
    monkeypatch.setattr(launch.time, "monotonic", lambda: 101.0)
    found = launch._all({0: Process(), 1: Process()}, {1: first})
    assert root_cause(found).rank == 0
    Process.exitcode = 3
    assert "exit code 3" in launch._all({0: Process()}, {})[0].text


@pytest.mark.parametrize("rank", [True, False])
def test_a_rank_leaves_before_its_interpreter_can_be_aborted(rank: bool) -> None:
    code = (
        "import atexit, runpy, sys\n"
        "atexit.register(print, 'shut down')\n"
        "sys.argv = ['fluxvla', 'no-such-command']\n"
        "runpy.run_module('fluxvla_core', run_name='__main__')\n"
    )
    environment = {k: v for k, v in os.environ.items() if k != "WORLD_SIZE"}
    if rank:
        environment["WORLD_SIZE"] = "1"
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert "no command 'no-such-command'" in done.stderr
    assert done.stdout == ("" if rank else "shut down\n")
