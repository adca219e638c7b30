"""Real trainings as separate processes: how they are started, watched and looked into."""

from __future__ import annotations

import json
import os
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

PLUGIN = '''\
import time
from fluxvla_core import DATASETS
from fluxvla_core.testing import training


@DATASETS.register_module()
class Slow(training.TinyDataset):
    """Samples that take long enough for a run to be looked at while it trains."""

    def get_sample(self, index, epoch):
        time.sleep(0.005)
        return super().get_sample(index, epoch)
'''
CONFIG = """\
model = dict(type="TinyVLA")
train_dataloader = dict(per_device_batch_size=2, per_device_num_workers=0,
                        dataset=dict(type="Slow"))
runner = dict(type="DDPTrainRunner", max_steps=100000, save_iter_interval=100000,
              log_iter_interval=1, learning_rate=1e-3,
              collator=dict(type="DictCollator",
                            keys=["states", "actions", "noise", "sample_ids"]))
"""
RUN = ("-m", "fluxvla_core", "run")
FORMS = {
    "plain": (RUN, ()),
    "nproc": (RUN, ("--nproc", "2")),
    "torchrun": (
        ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", *RUN),
        (),
    ),
}
"""Ways to start a training: what comes before the options of ``run``, and more options."""


class Job:
    """A training in a session of its own, as a terminal or a scheduler has it.

    Use as a context manager: at the end nothing of it is left.
    """

    def __init__(
        self, form: str, *words: str, workers: int = 0, work_dir: str = "work", nohup: bool = False
    ) -> None:
        before, after = FORMS[form]
        Path("tiny.py").write_text(PLUGIN)
        Path("tiny_config.py").write_text(CONFIG)
        self.work_dir = Path(work_dir)
        words = ("--config", "tiny_config.py", "--plugin", "tiny.py", *words)
        words += ("--work-dir", work_dir)
        words += ("--set", f"train_dataloader.per_device_num_workers={workers}")
        self.process = subprocess.Popen(
            [*(["nohup"] if nohup else []), sys.executable, *before, *words, *after],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            start_new_session=True,
        )

    def __enter__(self) -> Job:
        return self

    def __exit__(self, *details: object) -> None:
        left = self.processes()
        for pid in left:
            kill(pid)
        self.process.communicate(timeout=60)

    def processes(self) -> list[int]:
        """All of it that live, the one that was started first."""
        return tree(self.process.pid) if self.process.poll() is None else []

    def rank(self, rank: int) -> int:
        """The process of that rank: the first of those that have its environment."""
        wanted = f"RANK={rank}".encode()
        for pid in self.processes():
            if wanted in Path(f"/proc/{pid}/environ").read_bytes().split(b"\0"):
                return pid
        raise LookupError(rank)

    def steps(self) -> int:
        """The step of the last whole line of ``metrics.jsonl``; 0 without one."""
        try:
            lines = (self.work_dir / "metrics.jsonl").read_text().split("\n")[:-1]
        except OSError:
            return 0
        return int(json.loads(lines[-1])["step"]) if lines else 0

    def train(self, steps: int) -> None:
        """Wait until that many steps are done."""
        self.wait_for(lambda: self.steps() >= steps)

    def wait_for(self, done: Callable[[], bool]) -> None:
        until = time.monotonic() + 400
        while not done():
            assert self.process.poll() is None, self.process.communicate()
            assert time.monotonic() < until, "nothing came of it"
            time.sleep(0.02)

    def ended(self) -> tuple[int, str, str]:
        """Exit code, output and errors."""
        out, err = self.process.communicate(timeout=400)
        return self.process.returncode, out, err


def tree(root: int) -> list[int]:
    """Process ``root`` and all that descend from it."""
    children: dict[int, list[int]] = {}
    for path in Path("/proc").glob("[0-9]*"):
        try:
            fields = (path / "stat").read_text().rpartition(") ")[2].split()
        except OSError:
            continue
        if fields[0] != "Z":
            children.setdefault(int(fields[1]), []).append(int(path.name))
    found = [root]
    for pid in found:
        found += children.get(pid, [])
    return found


def alive(pids: Sequence[int]) -> list[int]:
    """Those that have not ended."""
    found = []
    for pid in pids:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2][0]
        except OSError:
            continue
        if state != "Z":
            found.append(pid)
    return found


def gone(pids: Sequence[int], seconds: float = 20.0) -> bool:
    """Whether all end within ``seconds``."""
    until = time.monotonic() + seconds
    while alive(pids):
        if time.monotonic() > until:
            return False
        time.sleep(0.05)
    return True


def kill(pid: int, number: int = 9) -> None:
    """Send a signal; one that has ended needs none."""
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        return


def listening(pids: Sequence[int]) -> list[str]:
    """``address:port`` of each TCP socket on which one of these processes accepts connections."""
    inodes = set()
    for pid in pids:
        for link in Path(f"/proc/{pid}/fd").glob("*"):
            try:
                target = os.readlink(link)
            except OSError:
                continue
            if target.startswith("socket:["):
                inodes.add(target[8:-1])
    found = []
    for table in ("tcp", "tcp6"):
        for line in Path("/proc/net", table).read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A" and fields[9] in inodes:
                address, _, port = fields[1].partition(":")
                found.append(f"{_address(address)}:{int(port, 16)}")
    return sorted(found)


def _address(text: str) -> str:
    words = [struct.pack("=I", int(text[i : i + 8], 16)) for i in range(0, len(text), 8)]
    family = socket.AF_INET if len(words) == 1 else socket.AF_INET6
    return socket.inet_ntop(family, b"".join(words))


def outside(pids: Sequence[int]) -> list[str]:
    """Of :func:`listening`, those that other machines can reach."""
    inside = ("127.", "::1:", "::ffff:127.")
    return [place for place in listening(pids) if not place.startswith(inside)]


linux = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")


def seen_outside(*words: str) -> tuple[int, set[str]]:
    """``fluxvla *words`` from beginning to end: how often it was looked at, and what was open."""
    looks, found = 0, set()
    with subprocess.Popen(
        [sys.executable, "-m", "fluxvla_core", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    ) as process:
        while process.poll() is None:
            found.update(outside(tree(process.pid)))
            looks += 1
            time.sleep(0.05)
        assert process.stdout is not None
        assert process.returncode == 0, process.stdout.read().decode()
    return looks, found
