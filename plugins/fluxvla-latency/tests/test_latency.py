"""The CSV that the hook writes of what it is told."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from fluxvla_latency import LatencyLog

from fluxvla_core import HOOKS, RunContext
from fluxvla_core.errors import ConfigError
from fluxvla_core.hooks import HookCaller, build_hooks

ARRAY = np.zeros(2)


def play(hooks: HookCaller, commands: int = 3) -> None:
    """One run of two episodes, with one answer each."""
    hooks.call("run_started", embodiment=None)
    for start in (10.0, 20.0):
        hooks.call("episode_started", task="wave", stamp=start)
        hooks.call("inferred", chunk=ARRAY[None], latency_s=0.25, stamp=start)
        for i in range(commands):
            sent = {"action": ARRAY, "target": ARRAY, "state": None}
            hooks.call("action_sent", stamp=start + i * 0.02, **sent)
        hooks.call("episode_finished", reason="max_steps", stamp=start + 1)
    hooks.call("run_finished", outcome="ok")


def rows(folder: Path, name: str = "latency.csv") -> list[list[str]]:
    with (folder / name).open(newline="") as file:
        return list(csv.reader(file))


def test_a_row_for_each_answer_and_each_interval_of_an_episode(tmp_path: Path) -> None:
    assert HOOKS.get("LatencyLog") is LatencyLog
    play(build_hooks(RunContext(config={"hooks": ["LatencyLog"]}, work_dir=tmp_path)))
    assert rows(tmp_path) == [
        ["stamp_s", "episode", "kind", "seconds"],
        ["10.000000", "1", "policy", "0.250000"],
        ["10.020000", "1", "command", "0.020000"],
        ["10.040000", "1", "command", "0.020000"],
        ["20.000000", "2", "policy", "0.250000"],
        ["20.020000", "2", "command", "0.020000"],
        ["20.040000", "2", "command", "0.020000"],
    ]


def test_another_run_is_appended(tmp_path: Path) -> None:
    context = RunContext(work_dir=tmp_path)
    for _ in range(2):
        play(HookCaller(context, [("LatencyLog", LatencyLog("logs/a.csv"))]), commands=0)
    found = rows(tmp_path, "logs/a.csv")
    assert [row[2] for row in found] == ["kind", "policy", "policy", "policy", "policy"]


def test_every_nth_of_each_kind(tmp_path: Path) -> None:
    play(HookCaller(RunContext(work_dir=tmp_path), [("LatencyLog", LatencyLog(every=3))]), 5)
    kinds = [row[2] for row in rows(tmp_path)[1:]]
    assert kinds == ["policy", "command", "command", "command"]


@pytest.mark.parametrize("wrong", [{"every": 0}, {"file": "/tmp/a.csv"}, {"file": "../a.csv"}])
def test_what_cannot_be_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match="LatencyLog: "):
        LatencyLog(**wrong)
