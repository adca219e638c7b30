"""Saving: what a failure at any moment leaves behind."""

from __future__ import annotations

import errno
import os
import resource
import shutil
import subprocess
import sys

import pytest

from fluxvla_core.atomic import prepare_folder
from fluxvla_core.checkpoints.checkpoint import (
    Checkpoint,
    clear_leftovers,
    folders,
    latest,
    name_best,
    rotate,
    set_aside_later,
)
from fluxvla_core.checkpoints.writer import CheckpointWriter, Disk
from fluxvla_core.errors import RunFailed, UsageError


def write(work_dir, step, disk=None, text=b"weights"):
    with CheckpointWriter(work_dir, step, step // 10, disk) as writer:
        writer.write_bytes("model.safetensors", text * step)
        writer.write_json("trainer.json", {"step": step, "loss": 0.1 + 0.2})
        writer.write_bytes("rng/rank-00000.safetensors", b"r")
        writer.write_folder("processors", lambda folder: (folder / "t.json").write_text("{}"))
        writer.add_folder("processors")
        return writer.commit()


def write_together(work_dir, step, disk=None):
    """Two ranks write one checkpoint; what kills one of them here kills both."""
    first, second = (CheckpointWriter(work_dir, step, 0, disk, rank=rank) for rank in (0, 1))
    first.begin("optimizer")
    for writer in (second, first):
        writer.write_bytes(f"optimizer/rank-0000{writer.rank}.safetensors", b"p" * step)
    first.write_bytes("model.safetensors", b"weights")
    first.merge_reports([first.rank_report(), second.rank_report()])
    return first.commit()


class Killed(BaseException):
    """Stands for SIGKILL: nothing handles it, and nothing more reaches the disk."""


class Failing(Disk):
    """Raises ``error`` at the ``number``-th operation, and at every one after it if ``dead``."""

    def __init__(self, number, error, dead):
        self.number, self.error, self.dead, self.done = number, error, dead, 0

    def _count(self):
        self.done += 1
        if self.done == self.number or (self.dead and self.done > self.number):
            raise self.error

    def __getattribute__(self, name):
        value = super().__getattribute__(name)
        if name in vars(Disk) and not name.startswith("_"):

            def run(*args):
                self._count()
                return value(*args)

            return run
        return value


def operations(tmp_path, write):
    counting = Failing(10**9, None, False)
    write(tmp_path / "count", 10, counting)
    return counting.done


@pytest.mark.parametrize("write", [write, write_together])
def test_a_kill_at_any_file_operation_keeps_the_checkpoint_before(tmp_path, write):
    total = operations(tmp_path, write)
    assert total > 15
    for number in range(1, total + 1):
        work = tmp_path / str(number)
        before = write(work, 10)
        with pytest.raises(Killed):
            write(work, 20, Failing(number, Killed(), dead=True))
        newest = latest(work)
        newest.verify()
        assert newest.step == (20 if number == total else 10), number
        Checkpoint.open(before).verify()
        clear_leftovers(work)
        assert {p.name for p in (work / "checkpoints").iterdir()} == {p.name for p in folders(work)}
        write(work, 30).joinpath("manifest.json").read_bytes()
        assert latest(work).step == 30


@pytest.mark.parametrize("write", [write, write_together])
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO])
def test_an_error_at_any_file_operation_keeps_the_checkpoint_before(tmp_path, number, write):
    for at in range(1, operations(tmp_path, write) + 1):
        work = tmp_path / str(at)
        write(work, 10)
        with pytest.raises(RunFailed) as caught:
            write(work, 20, Failing(at, OSError(number, os.strerror(number)), dead=False))
        assert caught.value.exit_code == 1
        message = str(caught.value)
        assert "step 20" in message
        assert "the checkpoints before it are as they were" in message
        assert ("the disk is full" in message) == (number == errno.ENOSPC)
        latest(work).verify()
        # After the last rename only its durability is unknown: the folder itself is whole.
        assert [p.name for p in (work / "checkpoints").iterdir()] in (
            [["step-000000010"]]
            if latest(work).step == 10
            else [["step-000000010", "step-000000020"], ["step-000000020", "step-000000010"]]
        )


def test_a_rank_that_does_not_see_the_folder_says_so(tmp_path):
    first = CheckpointWriter(tmp_path / "here", 5, 0)
    second = CheckpointWriter(tmp_path / "elsewhere", 5, 0, rank=1)
    first.begin("optimizer")
    second.write_bytes("optimizer/rank-00001.safetensors", b"x")
    first.merge_reports([second.rank_report()])
    seen = "No such file or directory, on rank 1, which may not see the first rank's work dir"
    with pytest.raises(RunFailed, match=seen):
        first.commit()
    assert not (tmp_path / "elsewhere").exists()


def test_a_limit_on_file_sizes_is_a_full_disk(tmp_path):
    """The provocation is real: the kernel refuses to let the file grow."""
    code = (
        "import sys, resource; from pathlib import Path\n"
        "from fluxvla_core.checkpoints.writer import CheckpointWriter\n"
        "def save(step, size):\n"
        "    with CheckpointWriter(Path(sys.argv[1]), step, 0) as writer:\n"
        "        writer.write_bytes('model.safetensors', b'x' * size)\n"
        "        writer.commit()\n"
        "save(1, 1000)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))\n"
        "try:\n    save(2, 100_000)\n"
        "except Exception as error:\n    print(error); sys.exit(error.exit_code)\n"
    )
    assert resource.getrlimit(resource.RLIMIT_FSIZE)[1] == resource.RLIM_INFINITY
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1, done.stderr
    assert "the disk is full: the checkpoint of step 2 could not be saved" in done.stdout
    assert "next: make room, then run the same command with --resume auto" in done.stdout
    assert [p.name for p in (tmp_path / "checkpoints").iterdir()] == ["step-000000001"]
    latest(tmp_path).verify()


def write_trainer(tmp_path, value):
    with CheckpointWriter(tmp_path, 1, 0) as writer:
        writer.write_bytes("model.safetensors", b"x")
        writer.write_json("trainer.json", value)


def test_an_exception_in_between_leaves_nothing(tmp_path):
    with pytest.raises(RunFailed, match=r"trainer\.json of the checkpoint cannot be written"):
        write_trainer(tmp_path, {"state": object()})
    assert list((tmp_path / "checkpoints").iterdir()) == []


def test_nan_is_no_json(tmp_path):
    with pytest.raises(RunFailed, match="cannot be written as JSON: Out of range float"):
        write_trainer(tmp_path, {"loss": float("nan")})


def test_a_step_that_is_there_already_is_kept_beside(tmp_path):
    write(tmp_path, 10, text=b"first")
    write(tmp_path, 10, text=b"second")
    assert (latest(tmp_path).path / "model.safetensors").read_bytes() == b"second" * 10
    aside = tmp_path / "checkpoints/step-000000010.set-aside/model.safetensors"
    assert aside.read_bytes() == b"first" * 10


def test_floats_in_json_keep_every_bit(tmp_path):
    assert Checkpoint.open(write(tmp_path, 10)).json("trainer.json")["loss"] == 0.1 + 0.2


def test_rotation_goes_by_step_whatever_the_file_times_say(tmp_path):
    """T10 of upstream's bugs: rotation went by modification time."""
    for step in (9, 10, 100, 1000):
        path = write(tmp_path, step)
        os.utime(path, (2_000_000_000 - step, 2_000_000_000 - step))
    assert [p.name for p in rotate(tmp_path, 2)] == ["step-000000009", "step-000000010"]
    assert [p.name for p in folders(tmp_path)] == ["step-000000100", "step-000001000"]


def test_keeping_none_means_keeping_all(tmp_path):
    """T10 of upstream's bugs: ``[:-0]`` deletes nothing or everything by accident."""
    for step in (1, 2, 3):
        write(tmp_path, step)
    assert rotate(tmp_path, 0) == []
    assert len(folders(tmp_path)) == 3


def test_a_kill_while_removing_leaves_no_torn_checkpoint(tmp_path):
    for at in (1, 2):
        work = tmp_path / str(at)
        write(work, 10)
        write(work, 20)
        with pytest.raises(Killed):
            rotate(work, 1, Failing(at, Killed(), dead=True))
        for folder in folders(work):
            Checkpoint.open(folder).verify()
        clear_leftovers(work)
        assert all(p in folders(work) for p in (work / "checkpoints").iterdir())


def test_later_checkpoints_are_set_aside_and_never_overwritten(tmp_path):
    for _ in range(2):
        for step in (10, 20, 30):
            if not (tmp_path / "checkpoints" / f"step-{step:09d}").exists():
                write(tmp_path, step)
        set_aside_later(tmp_path, 10)
    assert sorted(p.name for p in (tmp_path / "checkpoints").iterdir()) == [
        "step-000000010",
        "step-000000020.set-aside",
        "step-000000020.set-aside-2",
        "step-000000030.set-aside",
        "step-000000030.set-aside-2",
    ]
    assert latest(tmp_path).step == 10


def test_best_names_a_checkpoint_that_is_there_or_nothing(tmp_path):
    """A link left behind would name whatever is saved under its target's name next."""
    best = tmp_path / "checkpoints/best"
    write(tmp_path, 10)
    assert name_best(tmp_path, 10)
    assert os.readlink(best) == "step-000000010"
    assert not name_best(tmp_path, 20)
    assert not best.is_symlink()
    assert not name_best(tmp_path, -1)


def test_a_work_dir_that_cannot_be_written_is_refused_before_training(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError) as caught:
        prepare_folder(tmp_path / "file" / "run", "folder of the checkpoints", next="other DIR")
    assert caught.value.exit_code == 2
    assert str(caught.value) == (
        f"{tmp_path}/file/run: cannot write to the folder of the checkpoints: Not a directory\n"
        "  next: other DIR"
    )


@pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="needs another user to be")
def test_no_permission_is_refused_before_training(tmp_path):
    tmp_path.chmod(0o755)
    (tmp_path / "run").mkdir(mode=0o755)
    pid = os.fork()
    if pid == 0:
        os.setuid(65534)
        try:
            prepare_folder(tmp_path / "run", "folder of the checkpoints", next="other DIR")
        except UsageError as error:
            os._exit(7 if "Permission denied" in str(error) else 8)
        os._exit(9)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 7


def test_a_folder_that_was_removed_meanwhile_is_not_made_again(tmp_path):
    writer = CheckpointWriter(tmp_path / "work", 5, 0)
    writer.begin()
    shutil.rmtree(tmp_path / "work")
    writer.write_folder("processors", lambda folder: None)
    writer.write_bytes("random/rank-00000.safetensors", b"x")
    with pytest.raises(RunFailed, match="No such file or directory"):
        writer.commit()
    assert list(tmp_path.iterdir()) == []
