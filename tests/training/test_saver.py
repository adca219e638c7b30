"""Saving beside the training: what is saved, what waits, and where errors come out."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
import threading
import time
import weakref

import pytest
import torch

from fluxvla_core.checkpoints import tensors
from fluxvla_core.checkpoints.checkpoint import Checkpoint, folders
from fluxvla_core.checkpoints.writer import Disk
from fluxvla_core.errors import RunFailed
from fluxvla_core.testing.training import (
    KEYS,
    DictCollator,
    checkpoint_differences,
    tiny_config,
    train,
)
from fluxvla_core.training import saving


def config(**settings):
    table = {"type": "OneProcessRunner", "max_steps": 6, "save_iter_interval": 2, "ema_decay": 0.9}
    return tiny_config({**table, "max_keep_ckpts": 0, **settings})


def run(work_dir, **settings):
    train({"config": config(**settings), "work_dir": str(work_dir)})
    return folders(work_dir)


def test_it_saves_the_moment_however_long_the_copy_takes(tmp_path, monkeypatch):
    """The next step's forward pass runs during the copy; its optimizer waits for it."""
    at_once = run(tmp_path / "at once", async_save=False)
    copy = saving.Saver._host_copy

    def slow(self, *place_and_tensor):
        time.sleep(0.01)
        return copy(self, *place_and_tensor)

    monkeypatch.setattr(saving.Saver, "_host_copy", slow)
    beside = run(tmp_path / "beside")
    assert len(at_once) == len(beside) == 3
    for a, b in zip(at_once, beside, strict=True):
        assert [n.rpartition("/")[2] for n in checkpoint_differences(a, b)] == [
            "config.resolved.json"
        ]


class Watching(DictCollator):
    """Lets the disk go on when the ``batch``-th batch is asked for."""

    def __init__(self, batch, event):
        super().__init__(KEYS)
        self.left, self.event = batch, event

    def __call__(self, samples):
        self.left -= 1
        if self.left == 0:
            self.event.set()
        return super().__call__(samples)


def test_steps_do_not_wait_for_the_disk(tmp_path, monkeypatch):
    """The first save cannot end before three more steps have begun."""
    event, create = threading.Event(), Disk.create

    def held(self, path):
        assert event.wait(60.0), "the training waits for the disk"
        return create(self, path)

    monkeypatch.setattr(Disk, "create", held)
    saved = run(tmp_path, save_iter_interval=4, max_steps=8, collator=Watching(7, event))
    assert [path.name for path in saved] == ["step-000000004", "step-000000008"]


@pytest.mark.parametrize("beside", [True, False])
def test_a_disk_that_fills_up_ends_the_run_and_keeps_what_was_there(tmp_path, monkeypatch, beside):
    create = Disk.create

    def full(self, path):
        if "step-000000004" in str(path) and path.name == "optimizer.safetensors":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return create(self, path)

    monkeypatch.setattr(Disk, "create", full)
    with pytest.raises(RunFailed) as caught:
        run(tmp_path, max_steps=2000, save_iter_interval=2, max_keep_ckpts=2, async_save=beside)
    assert "the disk is full: the checkpoint of step 4 could not be saved" in str(caught.value)
    assert "the checkpoints before it are as they were" in str(caught.value)
    (left,) = folders(tmp_path)
    assert left.name == "step-000000002"
    Checkpoint.open(left).verify()
    assert [p.name for p in left.parent.iterdir()] == [left.name]


def test_the_last_save_that_fails_fails_the_run(tmp_path, monkeypatch):
    def broken(self, file, data):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(Disk, "write", broken)
    with pytest.raises(
        RunFailed, match=r"the checkpoint of step 3 could not be saved: .*Input/out"
    ):
        run(tmp_path, max_steps=3, save_iter_interval=5)
    assert folders(tmp_path) == []


def test_what_is_no_error_of_the_disk_fails_the_run_too(tmp_path, monkeypatch):
    def no_memory(self, *place_and_tensor):
        raise MemoryError("cannot allocate 7 bytes")

    monkeypatch.setattr(saving.Saver, "_host_copy", no_memory)
    with pytest.raises(RunFailed, match="of step 2 could not be saved: MemoryError: cannot alloc"):
        run(tmp_path)


def test_memory_is_kept_from_save_to_save(tmp_path, monkeypatch):
    made = []
    empty = torch.empty

    def counted(*args, **kwargs):
        if threading.current_thread().name.startswith("checkpoint-"):
            made.append(threading.current_thread().name)
        return empty(*args, **kwargs)

    monkeypatch.setattr(saving.torch, "empty", counted)
    run(tmp_path)
    assert set(made) == {"checkpoint-2"}


def test_what_is_gathered_from_several_processes_is_let_go_one_by_one(tmp_path, monkeypatch):
    """Gathering is pretended: one process has everything anyhow. Real ones save in
    test_exact_resume.py."""
    alive: list[weakref.ref[torch.Tensor]] = []
    most = []

    def pretended(tensor):
        gathered = tensor.detach().clone()
        alive[:] = [ref for ref in alive if ref() is not None] + [weakref.ref(gathered)]
        most.append(len(alive))
        return gathered

    plain = run(tmp_path / "plain")
    monkeypatch.setattr(tensors, "is_sharded", lambda tensor: True)
    monkeypatch.setattr(tensors, "full_tensor", pretended)
    split = run(tmp_path / "split")

    assert len(most) > 10
    assert max(most) <= 2
    for a, b in zip(plain, split, strict=True):
        assert checkpoint_differences(a, b) == []


def test_copies_wait_for_nothing_without_a_job():
    world = saving.World(0, 1, 0, torch.device("cpu"))
    idle = saving.Saver(world, True)
    idle.wait_for_copies()
    idle.close()
    assert idle.finish_pending(wait=True) is None


SMALL = """
import sys
from fluxvla_core.testing.training import tiny_config, train
config = tiny_config({"type": "OneProcessRunner", "max_steps": 400, "save_iter_interval": 20,
                      "max_keep_ckpts": 0}, width=64)
try:
    train({"config": config, "work_dir": sys.argv[1]})
except Exception as error:
    print(error)
    sys.exit(error.exit_code)
"""


def test_a_disk_that_is_really_full(tmp_path):
    """A tmpfs of two megabytes: the kernel says ENOSPC in the middle of some checkpoint."""
    mount = "mount -t tmpfs -o size=2m none"
    inside = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c"]
    if (
        shutil.which("unshare") is None
        or subprocess.run(
            [*inside, f"{mount} {tmp_path}"], capture_output=True, check=False
        ).returncode
    ):
        pytest.skip("no file system can be mounted here")
    (tmp_path / "disk").mkdir()
    script = f"{mount} {tmp_path}/disk && {sys.executable} {tmp_path}/small.py {tmp_path}/disk; "
    script += f"code=$?; cp -r {tmp_path}/disk {tmp_path}/kept; exit $code"
    (tmp_path / "small.py").write_text(SMALL)
    done = subprocess.run([*inside, script], capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stderr
    assert "the disk is full: the checkpoint of step" in done.stdout
    assert "likely cause: No space left on device" in done.stdout
    saved = folders(tmp_path / "kept")
    assert saved
    for folder in saved:
        Checkpoint.open(folder).verify()
    assert {p.name for p in saved[0].parent.iterdir()} == {p.name for p in saved}
