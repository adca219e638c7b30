"""The demo's own training, killed in the middle: its model, images, noise and command line."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from fluxvla_core.cli.main import main

pytest.importorskip("fluxvla_models")
pytest.importorskip("fluxvla_fsdp")
training = pytest.importorskip("fluxvla_core.testing.training")

CONFIG = Path(__file__).resolve().parents[3] / "configs" / "aloha_sim_transfer.py"
SMALL = (
    *("train_dataloader.per_device_batch_size=4", "runner.max_steps=30"),
    "runner.save_iter_interval=3",
)


def start(dataset: Path, work: Path, *more: str) -> subprocess.Popen[str]:
    """``fluxvla run`` of the demo over two processes, in a group of its own."""
    sets = (f"train_dataloader.dataset.data_root_path={dataset}", *SMALL)
    words = [w for one in sets for w in ("--set", one)]
    return subprocess.Popen(
        [
            *(sys.executable, "-m", "fluxvla_core", "run", "--config", str(CONFIG)),
            *("--section", "runner", "--nproc", "2", "--work-dir", str(work), *words, *more),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def finish(process: subprocess.Popen[str]) -> str:
    said, _ = process.communicate(timeout=900)
    assert process.returncode == 0, said
    return said


@pytest.mark.early
def test_the_demo_killed_and_resumed_equals_one_that_was_not(tmp_path):
    dataset, whole, cut = (tmp_path / name for name in ("dataset", "whole", "cut"))
    assert main(["collect", "aloha", "--out", str(dataset), "--episodes", "2"]) == 0
    finish(start(dataset, whole))
    process = start(dataset, cut)
    try:
        training.await_checkpoint(cut)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
    process.communicate(timeout=60)
    assert process.returncode == -signal.SIGKILL
    assert not (cut / "checkpoints" / "step-000000030").exists()
    assert "resum" in finish(start(dataset, cut, "--resume", "auto"))
    assert training.differences(whole, cut) == []
