"""A run that is killed at any moment and resumed is the run that was not.

Weights, averages, optimizer, schedule, random states and logged numbers are compared bit by bit.
What one strategy must do besides is in its own plugin's tests.
"""

from __future__ import annotations

import random
import signal
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from fluxvla_core.testing.train_runner import LENGTH, TrainRunnerConformance
from fluxvla_core.testing.training import (
    await_checkpoint,
    differences,
    run_ranks,
    tiny_config,
    train,
    train_all,
    unflushed,
)

pytest.importorskip("peft")

LORA = {"rank": 2, "target_modules": ["linear"], "modules_to_save": ["head"]}


class TestOneProcess(TrainRunnerConformance):
    entry_point = "OneProcessRunner"
    ranks = 1


@dataclass(frozen=True)
class Case:
    """One way to train: ``length`` steps or epochs, ``parts`` batches a step, loader workers."""

    kind: str
    length: str
    parts: int
    workers: int
    lora: bool

    @property
    def ranks(self) -> int:
        return 1 if self.kind == "OneProcessRunner" else 2

    def config(self, base: Path) -> dict[str, Any]:
        kind, _, strategy = self.kind.partition(" ")
        table = {
            "type": kind,
            "ema_decay": 0.9,
            "weight_decay": 0.1,
            "lr_scheduler_type": "linear-warmup+cosine-decay",
            "warmup_ratio": 0.2,
            "log_iter_interval": 3,
            "max_keep_ckpts": 0,
            "grad_accumulation_steps": self.parts,
            **LENGTH[self.length],
        }
        if strategy:
            table["sharding_strategy"] = strategy
        if self.lora:
            table.update(lora=LORA, init_from=str(base))
        batch = 6 // (self.parts * self.ranks) or 1
        return tiny_config(table, batch, self.workers, centred=True)

    @property
    def forwards(self) -> tuple[int, int]:
        """Forward passes of a rank until the first save, and in all."""
        steps = {"steps": (4, 9), "epochs": (3, 15)}[self.length]
        return steps[0] * self.parts, steps[1] * self.parts


STRATEGIES = ("full-shard", "shard-grad-op", "hybrid-shard", "no-shard")
KINDS = ("OneProcessRunner", "DDPTrainRunner", *(f"FSDPTrainRunner {s}" for s in STRATEGIES))
ALL = [Case(*values) for values in product(KINDS, LENGTH, (1, 4), (0, 2), (False, True))]
# Any two settings of any two columns meet in one of these.
PAIRS = [
    Case("OneProcessRunner", "steps", 1, 2, True),
    Case("OneProcessRunner", "epochs", 4, 0, False),
    Case("DDPTrainRunner", "steps", 4, 0, True),
    Case("DDPTrainRunner", "epochs", 1, 2, False),
    Case("FSDPTrainRunner full-shard", "steps", 4, 2, False),
    Case("FSDPTrainRunner full-shard", "epochs", 1, 0, True),
    Case("FSDPTrainRunner shard-grad-op", "steps", 1, 0, False),
    Case("FSDPTrainRunner shard-grad-op", "epochs", 4, 2, True),
    Case("FSDPTrainRunner hybrid-shard", "steps", 4, 2, True),
    Case("FSDPTrainRunner hybrid-shard", "epochs", 1, 0, False),
    Case("FSDPTrainRunner no-shard", "steps", 1, 0, True),
    Case("FSDPTrainRunner no-shard", "epochs", 4, 2, False),
]


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights for adapters to stand beside."""
    place = tmp_path_factory.mktemp("base")
    with unflushed():
        table = {"type": "OneProcessRunner", "max_steps": 1}
        train({"config": tiny_config(table, centred=True), "work_dir": place})
    return place


def test_any_two_settings_meet() -> None:
    columns = list(Case.__dataclass_fields__)
    for a, b in product(columns, columns):
        if a < b:
            wanted = {(getattr(case, a), getattr(case, b)) for case in ALL}
            assert {(getattr(case, a), getattr(case, b)) for case in PAIRS} == wanted, (a, b)


@pytest.mark.early
@pytest.mark.parametrize("ranks", [1, 2])
def test_a_killed_run_goes_on_bit_for_bit(tmp_path: Path, base: Path, ranks: int) -> None:
    """Killed in the middle of a step after a save; the dying of one resumes the one before."""
    cases = [case for case in PAIRS if case.ranks == ranks]
    drawn = random.Random(ranks)
    wholes, cuts, resumed = [], [], []
    for number, case in enumerate(cases):
        run = {"config": case.config(base), "work_dir": str(tmp_path / f"{number}-cut")}
        first, last = case.forwards
        moment = (drawn.randrange(ranks), drawn.randint(first + 1, last))
        wholes.append({**run, "work_dir": str(tmp_path / f"{number}-whole")})
        cuts.append({**run, "kill_forward": moment})
        resumed.append({**run, "resume": "auto"})
    starts = [[*wholes, cuts[0]]]
    starts += [[resumed[i], cuts[i + 1]] for i in range(len(cases) - 1)]
    for case, runs in zip(cases, starts, strict=True):
        codes = run_ranks(ranks, train_all, *runs)
        assert -signal.SIGKILL in codes, (case, codes)
        assert 0 not in codes, (case, codes)
    assert run_ranks(ranks, train_all, resumed[-1]) == [0] * ranks
    for case, whole, cut in zip(cases, wholes, cuts, strict=True):
        place = Path(cut["work_dir"])
        assert "resuming from" in (place / "said.txt").read_text(), case
        assert differences(Path(whole["work_dir"]), place) == [], case


@pytest.mark.slow
@pytest.mark.parametrize("case", ALL, ids=lambda c: "-".join(map(str, vars(c).values())))
def test_killed_at_random_moments(tmp_path: Path, base: Path, case: Case) -> None:
    """By the clock, from outside, any rank: three moments each, so 48 for each kind of runner."""
    config = case.config(base)
    run = {"config": config, "work_dir": str(tmp_path / "whole")}
    assert run_ranks(case.ranks, train, run) == [0] * case.ranks
    drawn = random.Random(repr(case))
    killed = 0
    for moment in range(3):
        place = tmp_path / f"cut-{moment}"
        cut = {"config": config, "work_dir": str(place), "nap_s": 0.4 / case.forwards[1]}
        delay, victim = drawn.uniform(0.0, 0.3), drawn.randrange(case.ranks)

        def end(processes: Sequence[Any], place=place, delay=delay, victim=victim) -> None:
            await_checkpoint(place)
            time.sleep(delay)
            processes[victim].kill()

        killed += -signal.SIGKILL in run_ranks(case.ranks, train, cut, watch=end)
        assert run_ranks(case.ranks, train, {**cut, "resume": "auto"}) == [0] * case.ranks
        assert differences(tmp_path / "whole", place) == [], (moment, delay)
    assert killed > 0


@pytest.mark.parametrize("operation", [1, 9, 31, 47, 48, 49, 50, 51, 52, 95, 100])
def test_killed_at_file_operations_of_its_saves(tmp_path: Path, operation: int) -> None:
    config = tiny_config(
        {"type": "OneProcessRunner", "max_steps": 6, "save_iter_interval": 2, "max_keep_ckpts": 2}
    )
    whole, cut = ({"config": config, "work_dir": str(tmp_path / name)} for name in "ab")
    train(whole)
    assert run_ranks(1, train, {**cut, "kill_write": operation}) == [-9]
    assert run_ranks(1, train, {**cut, "resume": "auto"}) == [0]
    assert differences(tmp_path / "a", tmp_path / "b") == []
