"""The kit of hooks: a right one passes, and each wrong one fails its own check in words."""

from __future__ import annotations

import pytest

from .specimens import Fault, Outcomes, check_fault, check_good, outcomes

GOOD = """
import threading, time
import numpy as np
from fluxvla_core import HOOKS, Hook
from fluxvla_core.testing import HookConformance

@HOOKS.register_module()
class Specimen(Hook):
    api = "1.0"
    def __init__(self, every: int = 1):
        self.every, self.seen, self.rows = every, 0, []
    def run_started(self, context):
        self.file = context.work_dir / "seen.txt"
    def after_step(self, step, metrics):
        self.seen += 1
    def inferred(self, chunk, latency_s):
        self.rows.append(chunk.mean())
    def run_finished(self, outcome):
        self.file.write_text(f"{outcome} {self.seen} {len(self.rows)}")

class TestSpecimen(HookConformance):
    entry_point = "Specimen"
"""
FAULTS = {
    "no version": Fault("is_complete", '    api = "1.0"\n', "", "the version of the contract"),
    "misspelt": Fault(
        "every_method_is_a_hook", "def after_step(self", "def after_steps(self",
        "after_steps() is called by nobody; expected after_step()",
    ),
    "a key of others": Fault(
        "a_training_can_be_watched", "self.seen += 1", 'self.seen += metrics["mfu"]',
        "it was given step 1, metrics {loss 1.0, lr 0.001,",
    ),
    "acts": Fault(
        "a_robot_can_be_watched", "self.rows.append(chunk.mean())", "chunk += 0.1",
        "watching a robot's run: hook Specimen",
    ),
    "waits for a step": Fault(
        "a_run_may_end_at_once", "{len(self.rows)}", "{len(self.rows)} "
        "{1 / (self.seen + len(self.rows))}",
        "before its first step",
    ),
    "changes metrics": Fault(
        "what_it_sees_is_not_its_own", "self.seen += 1", 'self.seen += 1; metrics.pop("lr")',
        "other hooks and the reporter",
    ),
    "slow": Fault(
        "it_is_quick_enough", "self.seen += 1", "self.seen += 1; time.sleep(0.03)",
        "it is left out when it falls behind its budget_s",
    ),
    "leaves a thread": Fault(
        "nothing_is_left_running", "        self.rows.append(chunk.mean())",
        "        self.rows.append(chunk.mean())\n"
        "        threading.Thread(target=time.sleep, args=(2,)).start()",
        "the process would never end",
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Outcomes:
    return outcomes(tmp_path_factory.mktemp("hooks"), GOOD, FAULTS)


def test_a_right_hook_passes_every_check(found: Outcomes) -> None:
    check_good(found, checks=9)


@pytest.mark.parametrize("name", FAULTS)
def test_a_wrong_hook_fails_its_own_check(found: Outcomes, name: str) -> None:
    check_fault(found, name, FAULTS[name])
