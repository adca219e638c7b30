"""Families trained on two processes that are killed, and resumed: bit for bit as without that.

The core's own tests kill at any moment (``tests/training/test_exact_resume.py``); here are the
real models, by the command line, with the transforms and samplers of the shipped configs.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("torch")
pytest.importorskip("mujoco")
pytest.importorskip("fluxvla_sim")

from fluxvla_core.testing import training

from .tiny import tiny

FAMILIES = {
    "pi0": "DDPTrainRunner",
    "pi05": "FSDPTrainRunner",
    "pi0_fast": "DDPTrainRunner",
    "gr00t_n15": "FSDPTrainRunner",
    "gr00t_n17": "DDPTrainRunner",
    "smolvla": "FSDPTrainRunner",
    "openvla": "FSDPTrainRunner",
    "openvla_oft": "DDPTrainRunner",
    "compact": "DDPTrainRunner",
    "llava": "FSDPTrainRunner",
    "act": "FSDPTrainRunner",
    "diffusion": "DDPTrainRunner",
}
STEPS, INTERVAL = 40, 10


def start(config: Path, strategy: str, work: Path, *more: str) -> subprocess.Popen[str]:
    """``fluxvla run`` over two processes, in a process group of its own."""
    sets = (
        f'runner.type="{strategy}"',
        f"runner.max_steps={STEPS}",
        f"runner.save_iter_interval={INTERVAL}",
    )
    words = [word for one in sets for word in ("--set", one)]
    return subprocess.Popen(
        [
            *(sys.executable, "-m", "fluxvla_core", "run", "--config", str(config)),
            *("--section", "runner", "--nproc", "2", "--work-dir", str(work), *words, *more),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def finish(process: subprocess.Popen[str]) -> str:
    said, _ = process.communicate(timeout=300)
    assert process.returncode == 0, said
    return said


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("family", FAMILIES)
def test_a_family_killed_and_resumed_equals_one_that_was_not(
    family: str, data: Path, tmp_path: Path
) -> None:
    config, strategy = tiny(family, tmp_path, data), FAMILIES[family]
    whole, cut = (tmp_path / name for name in ("whole", "cut"))
    finish(start(config, strategy, whole))
    process = start(config, strategy, cut)
    try:
        training.await_checkpoint(cut)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
    process.communicate(timeout=60)
    assert process.returncode == -signal.SIGKILL
    last = f"step-{STEPS:09d}"
    assert not (cut / "checkpoints" / last).exists()
    assert "resuming from" in finish(start(config, strategy, cut, "--resume", "auto"))
    assert len(training.losses(cut)) == STEPS
    assert training.differences(whole, cut) == []
