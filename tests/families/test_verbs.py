"""Every family trains, resumes, is exported, evaluated and drives the simulated arm: by commands.

With the shipped configs, whose models alone are tiny (``tiny.py``).
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("mujoco")
pytest.importorskip("fluxvla_sim")

from fluxvla_core.cli.main import main
from fluxvla_core.testing.training import checkpoint_differences

from .tiny import CONTINUES, SHIPPED, tiny, weights

QUICK = ("gr00t_n15", "llava", "diffusion")
"""Always run: a head of flow matching, one of queries, one of diffusion with two observations."""


@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    "family",
    [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in SHIPPED],
)
def test_a_family_from_data_to_a_moving_arm(family: str, data: Path, tmp_path: Path) -> None:
    config = tiny(family, tmp_path, data)

    def run(section: str, work: str, *more: str) -> None:
        words = ["run", "--config", str(config), "--section", section]
        assert main([*words, "--work-dir", str(tmp_path / work), *more]) == 0

    # Train; resume from the middle in another folder.
    run("runner", "work")
    saved = [tmp_path / "work" / "checkpoints" / f"step-{step:09d}" for step in (2, 4)]
    run("runner", "again", "--resume", str(saved[0]))
    resumed = tmp_path / "again" / "checkpoints" / saved[1].name
    assert checkpoint_differences(saved[1], resumed) == []
    before, after = weights(saved[0]), weights(saved[1])
    assert any((after[name] != before[name]).any() for name in after)

    # What is exported is all that acting needs.
    policy = tmp_path / "policy"
    assert main(["export", str(tmp_path / "work"), str(policy)]) == 0
    for folder in ("words", "fast", "work", "again"):
        shutil.rmtree(tmp_path / folder, ignore_errors=True)

    run("eval", "evaluated", "--set", f"eval.ckpt_path={policy}")
    results = json.loads((tmp_path / "evaluated" / "eval" / "results.json").read_text())
    assert results["groups"]["policy"]["all"]["episodes"] == 1

    joining = ["--set", 'inference.chunk_joining="rtc"'] if family in CONTINUES else []
    run("inference", "driven", "--task", "1", "--set", f"inference.ckpt_path={policy}", *joining)
    (trace,) = (tmp_path / "driven").rglob("trace.jsonl")
    rows = [json.loads(line) for line in trace.read_text().splitlines()]
    sent = np.array([row["command"] for row in rows if row.get("event") == "command"])
    assert sent.shape[1] == 14
    assert np.isfinite(sent).all()
    assert np.abs(np.diff(sent, axis=0)).max() > 0
