"""Every fault of the loop through ``fluxvla run``: one line that names it, exit code 1, a record.

The arm and the policy are in memory; what goes wrong is asked for by name. How it is stopped, with
which commands, is in ``test_faults.py``; what a signal does, in ``test_signals.py``.
"""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fluxvla_core.cli.main import main
from fluxvla_core.plugins.registry import RUNNERS
from fluxvla_core.robot.runner import BaseInferenceRunner
from tests.robot.conftest import TASKS, Arm, Waver

CONFIG = """
inference = dict(
    type="FaultyRunner", fault={fault!r}, task_descriptions={tasks!r}, record_fps=None,
    max_publish_step=500, **{settings!r})
"""


@dataclass(frozen=True)
class Fault:
    """How it is provoked, and what is expected of it."""

    rule: str
    said: str
    provoke: Callable[[Arm, Waver], None]
    realtime: bool = False
    settings: dict[str, Any] = field(default_factory=dict)


def chunks(change: Callable[[np.ndarray], np.ndarray], call: int = 2):
    def provoke(arm: Arm, policy: Waver) -> None:
        policy.faults[call] = change

    return provoke


def spoilt(value: float):
    def change(chunk):
        chunk[3, 1] = value
        return chunk

    return chunks(change)


def jumping(chunk):
    chunk[:2, 0], chunk[2:, 0] = 1.5, -1.0
    return chunk


def far(chunk):
    chunk[:, 0] = 9.0
    return chunk


def too_fast(chunk):
    """From one limit to the other and back in every tenth of a second."""
    chunk[::2, 1], chunk[1::2, 1] = 2.0, -2.0
    return chunk


def lagging(arm: Arm, policy: Waver) -> None:
    """The arm follows at a third of the speed: the error grows command by command."""
    policy.stride, send = 0.15, arm.send_action

    def follow(action):
        before, commanded = arm.state, arm.sent[-1] if arm.sent else arm.state
        send(action)
        arm.state = before + 0.3 * (action - commanded)

    arm.send_action = follow
    arm.get_state = lambda: arm.state


def slow(arm: Arm, policy: Waver) -> None:
    """Every answer takes longer than its chunk lasts."""

    def late(chunk):
        time.sleep(2.0)
        return chunk

    policy.faults = dict.fromkeys(range(3, 99), late)


def hanging(arm: Arm, policy: Waver) -> None:
    # The fourth answer at the earliest is in motion: slow ones before it are asked for again.
    policy.faults[4] = lambda chunk: time.sleep(6)


def raising(arm: Arm, policy: Waver) -> None:
    policy.faults[2] = ValueError("out of memory")


def cable(arm: Arm, policy: Waver) -> None:
    arm.faults = {"send_action": OSError("cable pulled"), "after": 7}


def frozen(arm: Arm, policy: Waver) -> None:
    arm.faults["frozen_after"] = 20


# Longer than machines that run tests stand still, which would be to blame then.
QUICK = {"safety": {"starvation_s": 1.0, "max_age_s": 5.0, "max_skew_s": 5.0}}
FAULTS = {
    "NaN in a chunk": Fault("chunk", "the policy's chunk is not finite", spoilt(np.nan)),
    "Inf in a chunk": Fault("chunk", "the policy's chunk is not finite", spoilt(np.inf)),
    "chunk of a wrong shape": Fault(
        "chunk", "chunk has shape (5, 2)", chunks(lambda chunk: chunk[:, :2])
    ),
    "chunk that jumps": Fault("chunk", "action 2 wants shoulder to jump", chunks(jumping)),
    "chunk beyond position limits": Fault("chunk", "far beyond its limits [-1, 1.5]", chunks(far)),
    "chunk faster than the velocity limit": Fault(
        "chunk", "wants elbow to jump by", chunks(too_fast)
    ),
    "tracking error grows": Fault("tracking", "away from its command for 0.2", lagging),
    "policy raises": Fault("policy", "the policy raised ValueError: out of memory", raising),
    "policy hangs": Fault("starvation", "the robot waits for a chunk", hanging, True, QUICK),
    "policy hangs in motion": Fault(
        "starvation",
        "the robot waits for a chunk",
        hanging,
        True,
        {**QUICK, "async_execution": True},
    ),
    "policy slower than real time": Fault(
        "starvation", "slower than its chunks are long", slow, True, QUICK
    ),
    "operator raises in send_action": Fault(
        "operator", "Arm.send_action raised OSError: cable pulled", cable
    ),
    "stream freezes": Fault("freshness", "stream state is stale", frozen),
}


@pytest.fixture
def arms():
    """The arms that runners made, in order."""
    made: list[Arm] = []

    class FaultyRunner(BaseInferenceRunner):
        def __init__(self, fault: str, **kwargs: Any) -> None:
            found = FAULTS[fault]
            arm, policy = Arm(realtime=found.realtime), Waver()
            found.provoke(arm, policy)
            made.append(arm)
            super().__init__(operator=arm, policy=policy, **kwargs)

    RUNNERS.register_module("FaultyRunner")(FaultyRunner)
    yield made
    RUNNERS.unregister("FaultyRunner")


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.realtime) if fault.realtime else name
        for name, fault in FAULTS.items()
    ],
)
def test_it_ends_in_a_stop_that_says_why(tmp_path: Path, capsys, arms, name: str) -> None:
    fault = FAULTS[name]
    config = tmp_path / "arm.py"
    config.write_text(CONFIG.format(fault=name, tasks=TASKS, settings=fault.settings))
    work = tmp_path / "work"

    code = main(["run", "--config", str(config), "--task", "1", "--work-dir", str(work)])

    printed = capsys.readouterr()
    assert code == 1, printed.err
    # The first line says it; what follows are likely causes and what to do next.
    assert fault.said in " ".join(printed.err.splitlines()[:2])
    assert "Traceback" not in printed.err
    (arm,) = arms
    assert arm.calls == ["connect", "stop", "stop", "close"]
    episode = work / "inference" / "001-1"
    summary = json.loads((episode / "episode.json").read_text())
    assert summary["outcome"] == "failed"
    assert summary["problem"] in printed.err
    assert [trip["rule"] for trip in summary["trips"]] == [fault.rule]
    rows = [json.loads(line) for line in (episode / "trace.jsonl").read_text().splitlines()]
    commands = [row["command"] for row in rows if row["event"] == "command"]
    np.testing.assert_array_equal(np.reshape(commands, (-1, 3)), np.reshape(arm.sent, (-1, 3)))
    (stop,) = [row for row in rows if row["event"] == "stop"]
    assert stop["rule"] == fault.rule


@pytest.mark.realtime
def test_a_stepped_wall_clock_changes_nothing(bench, make_arm, monkeypatch):
    """NTP or a person sets the clock, days to and fro, at every look at it."""
    bench.arm = make_arm(realtime=True)
    real, looks = time.time, []

    def stepped():
        looks.append(1)
        return real() + (-1) ** len(looks) * 86400.0 * len(looks)

    monkeypatch.setattr(time, "time", stepped)

    assert bench.run(max_publish_step=40)["outcome"] == "max_steps"

    stamps = [row["t"] for row in bench.trace()]
    assert stamps == sorted(stamps)
    assert stamps[-1] - stamps[0] < 60
    bench.assert_within_limits()


@pytest.mark.realtime
def test_a_policy_that_is_slow_now_and_then_is_waited_for(bench, make_arm):
    """Within ``starvation_s`` the arm brakes, holds, and goes on."""
    bench.arm = make_arm(realtime=True)

    def late(chunk):
        time.sleep(2.0)
        return chunk

    bench.policy.faults[4] = late

    result = bench.run(max_publish_step=220, safety={"starvation_s": 30.0, "max_age_s": 5.0})

    assert result["outcome"] == "max_steps"
    commands = [row for row in bench.trace() if row["event"] == "command"]
    # A brake or a hold is formed from the command before, and takes as long as the policy does.
    held = [b for a, b in itertools.pairwise(commands) if b["wanted"] == a["command"]]
    assert len(held) >= 10
    bench.assert_within_limits()
