"""The kit of training strategies: a right one passes, and each wrong one fails its own check.

Each strategy is trained, killed and resumed in processes of its own, which takes its time.
"""

from __future__ import annotations

import pytest

from .specimens import Fault, Outcomes, check_fault, check_good, outcomes

pytestmark = pytest.mark.slow

GOOD = """
import torch
from fluxvla_core.errors import RunFailed
from fluxvla_core.training import BaseTrainRunner

class Specimen(BaseTrainRunner):
    api = "1.0"
    def __init__(self, share: float = 1.0, **kwargs):
        super().__init__(**kwargs)
        self.share = share
    def backward(self, loss):
        (self.share * loss).backward()
    def clip_grad_norm(self):
        self.change()
        return super().clip_grad_norm()
    def change(self):
        pass
# the kit
from fluxvla_core.testing import TrainRunnerConformance

class TestSpecimen(TrainRunnerConformance):
    entry_point = "Specimen"
    ranks = 1
"""
CHANGE = "    def change(self):\n        pass\n"
KILLED = "a_killed_run_goes_on_bit_for_bit"
STOPPED = "one_rank_that_is_told_to_stop_stops_all_with_all_saved"
ALONE = "it_trains_as_one_process_does_and_goes_on_there"
FAULTS = {
    "no version": Fault("is_complete", 'api = "1.0"', "api = None", "the version of the contract"),
    "open": Fault(
        "constructor_names_every_parameter",
        "        super().__init__(**kwargs)\n",
        '        super().__init__(**{k: v for k, v in kwargs.items() if k != "colour"})\n',
        "expected every parameter by name",
    ),
    "a mean that is not saved": Fault(
        KILLED, CHANGE,
        "    mean = None\n" + CHANGE.replace("pass", "for p in self.model.parameters():\n"
        "            if p.grad is not None and p.ndim == 2 and len(p) == 6:\n"
        "                self.mean = 0.5 * p.grad + (0 if self.mean is None else 0.5 * self.mean)\n"
        "                p.grad.copy_(self.mean)"),
        "what the strategy keeps from one step to the next is not all in the checkpoint",
        (STOPPED, ALONE),
    ),
    "the last batch is dropped": Fault(
        ALONE, "        (self.share * loss).backward()\n",
        "        self.parts = getattr(self, 'parts', 0) + 1\n"
        "        parts = self.options.grad_accumulation_steps\n"
        "        if parts == 1 or self.parts % parts:\n"
        "            (self.share * loss).backward()\n",
        "the same samples in the same steps train the same",
    ),
    "no seed": Fault(
        "training_follows_from_its_seed",
        "        super().__init__(**kwargs)\n",
        "        kwargs['seed'] = 42\n        super().__init__(**kwargs)\n",
        "with seed = 42 and seed = 43 the weights are the same",
    ),
    "stops without a word": Fault(
        STOPPED, CHANGE,
        CHANGE + "    def run(self, vla_dataset):\n"
        "        try:\n            return super().run(vla_dataset)\n"
        "        except RunFailed:\n            return None\n",
        "all of them stop at the same step, with everything saved",
    ),
    "begins anew": Fault(
        KILLED, CHANGE, CHANGE + "    def resume(self):\n        return 0\n",
        "it began anew", (STOPPED, ALONE),
    ),
    "a scalar that is not refused": Fault(
        "parameters_without_dimensions_are_trained_or_refused", "    ranks = 1\n",
        "    ranks = 1\n    scalars = ()\n", "expected a ConfigError: it is none of scalars",
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Outcomes:
    return outcomes(tmp_path_factory.mktemp("strategies"), GOOD, FAULTS, "runners")


def test_a_right_strategy_passes_every_check(found: Outcomes) -> None:
    check_good(found, checks=7)


@pytest.mark.parametrize("name", FAULTS)
def test_a_wrong_strategy_fails_its_own_check(found: Outcomes, name: str) -> None:
    check_fault(found, name, FAULTS[name])
