"""Data that do not fit a family, for several processes: one error, and nothing is left of them."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("torch")
pytest.importorskip("mujoco")
pytest.importorskip("fluxvla_sim")

from fluxvla_core.checkpoints.writer import CheckpointWriter
from fluxvla_core.config.load import FORMAT

from .tiny import tiny

MARK = "FLUXVLA_TEST_RUN"


def started_with(mark: str) -> list[int]:
    """Processes that have ``mark`` in the environment that they were started with."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            environment = (path / "environ").read_bytes().split(b"\0")
        except OSError:  # it has ended, or is another user's
            continue
        if f"{MARK}={mark}".encode() in environment:
            found.append(int(path.name))
    return found


DATA = (
    'train_dataloader.dataset.img_keys=["top"]',
    "train_dataloader.dataset.action_window_size=5",
)
OF_DATA = (
    "act.py:1: model.num_cameras: ACT: the number of cameras is 2, in the data it is 1",
    "act.py:1: model.horizon: ACT: the number of actions in a chunk is 8, in the data it is 5",
)
WEIGHTS = ("runner.init_from={folder}/other",)
OF_WEIGHTS = ("the checkpoint is of DiffusionPolicy, the config's model is ACT",)
"""Found when the ranks have joined."""


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    ("strategy", "changes", "words"),
    [("DDPTrainRunner", DATA, OF_DATA), ("FSDPTrainRunner", WEIGHTS, OF_WEIGHTS)],
)
def test_two_ranks_with_loader_workers_give_one_error(
    strategy: str, changes: tuple[str, ...], words: tuple[str, ...], data: Path, tmp_path: Path
) -> None:
    config = tiny("act", tmp_path, data)
    with CheckpointWriter(tmp_path / "other", 1, 0) as writer:
        tree = {"format": FORMAT, "config": {"model": {"type": "DiffusionPolicy"}}, "origins": {}}
        writer.write_json("config.resolved.json", tree)
        writer.commit()
    settings = (f'runner.type="{strategy}"', "train_dataloader.per_device_num_workers=2", *changes)
    before = sorted(path.name for path in tmp_path.iterdir())
    process = subprocess.Popen(
        [
            *(sys.executable, "-m", "fluxvla_core", "run", "--config", str(config)),
            *("--section", "runner", "--nproc", "2", "--work-dir", str(tmp_path / "work")),
            *(word for one in settings for word in ("--set", one.format(folder=tmp_path))),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, MARK: str(tmp_path)},
        start_new_session=True,
    )
    out, err = process.communicate(timeout=240)
    assert process.returncode == 2, out + err
    for text in words:
        assert err.count(text) == 1
    assert err.count("next:") == 1
    assert "Traceback" not in out + err
    assert sorted(path.name for path in tmp_path.iterdir()) == before
    until = time.monotonic() + 20
    while left := started_with(str(tmp_path)):
        assert time.monotonic() < until, left
        time.sleep(0.1)
