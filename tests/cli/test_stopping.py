"""Trainings in processes of their own, however they were started.

They listen to this machine alone, save the step that they are at when they are told to stop, name a
rank that was killed, and leave a work dir alone that is not theirs any more.
"""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from fluxvla_core.checkpoints.checkpoint import folders
from fluxvla_core.checkpoints.manifest import step_of

from .jobs import FORMS, Job, gone, kill, linux, listening, outside

pytest.importorskip("torch")
pytestmark = linux

NAMES = ("SIGTERM", "SIGINT", "SIGHUP")
TARGETS = ("process", "group", "all")


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def tell(job: Job, target: str, number: int) -> None:
    """As ``kill`` does, as a terminal does, or as a scheduler does that ends a whole job."""
    if target == "process":
        os.kill(job.process.pid, number)
    elif target == "group":
        os.killpg(job.process.pid, number)
    else:
        for pid in job.processes():
            kill(pid, number)


def stops_with_all_saved(form: str, workers: int, name: str, target: str) -> None:
    number = getattr(signal, name)
    with Job(form, workers=workers) as job:
        job.train(3)
        pids, before = job.processes(), job.steps()
        # torchrun's own store is open to all; docs/clusters.md says what to do about it.
        ours = pids[1:] if form == "torchrun" else pids
        assert form == "plain" or listening(ours) != []
        assert outside(ours) == []
        tell(job, target, number)
        code, _, err = job.ended()
        assert code == (130 if number == signal.SIGINT and form != "torchrun" else 1), err
        if form != "torchrun":  # which tells of the signal by a traceback of its own
            at = f"step {job.steps()} in work"
            said = f"interrupted: {at}\n"
            if number != signal.SIGINT:
                said = f"training was stopped by {name}\n  likely cause: all is saved: {at}\n"
            assert err.startswith(said)
            assert "Traceback" not in err
        saved = [step_of(folder) for folder in folders(job.work_dir)]
        assert saved == [job.steps()]
        assert job.steps() >= before
        assert gone(pids)


@pytest.mark.parametrize(
    ("form", "workers", "name", "target"),
    [
        ("plain", 2, "SIGTERM", "group"),
        ("nproc", 2, "SIGHUP", "all"),
        ("torchrun", 2, "SIGTERM", "process"),
    ],
)
def test_a_signal_loses_no_step_and_nobody_can_connect(
    form: str, workers: int, name: str, target: str
) -> None:
    stops_with_all_saved(form, workers, name, target)


@pytest.mark.slow
@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("workers", [0, 2])
@pytest.mark.parametrize("form", FORMS)
def test_no_signal_loses_a_step(form: str, workers: int, name: str, target: str) -> None:
    stops_with_all_saved(form, workers, name, target)


@pytest.mark.parametrize("form", ["plain", "nproc"])
def test_under_nohup_a_closed_terminal_changes_nothing(form: str) -> None:
    with Job(form, workers=1, nohup=True) as job:
        job.train(3)
        pids, before = job.processes(), job.steps()
        tell(job, "all", signal.SIGHUP)
        job.train(before + 3)
        assert set(pids) <= set(job.processes())
        assert folders(job.work_dir) == []
        job.process.terminate()
        code, _, err = job.ended()
        assert code == 1
        assert "training was stopped by SIGTERM" in err
        assert [step_of(folder) for folder in folders(job.work_dir)] == [job.steps()]


@pytest.mark.parametrize("form", ["plain", "nproc"])
def test_sigquit_ends_a_training_at_once_without_saving(form: str) -> None:
    # A script that runs the tests in its background has them, and their children, ignore it.
    signal.signal(signal.SIGQUIT, signal.SIG_DFL)
    with Job(form, workers=1) as job:
        job.train(3)
        pids = job.processes()
        os.killpg(job.process.pid, signal.SIGQUIT)
        assert job.ended()[0] == -signal.SIGQUIT
        assert gone(pids)
        assert folders(job.work_dir) == []


@pytest.mark.parametrize("runner", ["DDPTrainRunner", "FSDPTrainRunner"])
def test_ranks_that_may_be_started_again_open_nothing_and_pickle_nothing(runner: str) -> None:
    """torch's own rendezvous unpickles what is under ``torch.rendezvous.<id>`` in its store."""
    from torch.distributed import TCPStore  # type: ignore[attr-defined]

    if runner == "FSDPTrainRunner":
        pytest.importorskip("fluxvla_fsdp")
    words = ("--max-restarts", "2", "--set", f"runner.type={runner}")
    with Job("nproc", *words) as job:
        job.train(2)
        pids = job.processes()
        assert listening(pids) != []
        assert outside(pids) == []
        environ = Path(f"/proc/{job.rank(1)}/environ").read_bytes().decode().split("\0")
        told = dict(line.split("=", 1) for line in environ if line)
        assert told["MASTER_ADDR"] == "127.0.0.1"
        store = TCPStore(told["MASTER_ADDR"], int(told["MASTER_PORT"]), is_master=False)
        keys = store.list_keys()
        assert keys
        assert [key for key in keys if "torch.rendezvous" in key] == []
        assert [key for key in keys if store.get(key).startswith(b"\x80")] == [], "pickled"


def test_a_killed_rank_is_named_and_not_the_workers_of_the_others() -> None:
    with Job("nproc", workers=2) as job:
        job.train(3)
        pids = job.processes()
        os.kill(job.rank(1), signal.SIGKILL)
        code, _, err = job.ended()
        assert code == 1
        assert err.startswith(
            "rank 1 ended without an error message: killed by SIGKILL\n"
            "  likely cause: this machine, or its container, ran out of memory"
        )
        assert gone(pids)


def test_a_work_dir_that_was_moved_is_left_to_the_training_that_began_there_since() -> None:
    with Job("nproc", "--max-restarts", "2") as first:
        first.train(3)
        Path("work").rename("old")
        with Job("plain") as second:
            second.train(1)
            code, _, err = first.ended()
            assert code == 1
            here = Path.cwd().resolve()
            assert err.startswith(
                f"the work dir {here}/work was taken away from this training, which has stopped\n"
                f"  likely cause: it is at {here}/old now; "
            )
            assert err.endswith("  next: start it again with a --work-dir that stays\n")
            second.process.terminate()
            assert second.ended()[0] == 1
        assert [step_of(folder) for folder in folders(Path("work"))] == [second.steps()]
        assert folders(Path("old")) == []
