"""The kit of training strategies: a right one passes, and each wrong one fails its own check.

The specimens train in processes of their own, on one rank and by steps alone; training by epochs
and on several ranks is tested with the strategies that there are.
"""

from __future__ import annotations

import pytest

from .specimens import Fault, Outcomes, check_fault, check_good, outcomes

GOOD = """
import torch
from fluxvla_core.errors import RunFailed
from fluxvla_core.training import BaseTrainRunner

class Wrapped(torch.nn.Module):
    def __init__(self, inner):
        super().__init__()
        self.inner = inner
    def forward(self, **batch):
        return self.inner(**batch)
    @property
    def head(self):
        return self.inner.head

class Specimen(BaseTrainRunner):
    api = "1.0"
    def __init__(self, share: float = 1.0, **kwargs):
        super().__init__(**kwargs)
        self.share, self.parts, self.mean = share, 0, 0.0
    def _wrap_model(self, vla):
        return super()._wrap_model(vla)
    def backward(self, loss):
        self.parts += 1
        (self.share * loss).backward()
    def clip_grad_norm(self):
        self.parts = 0
        self.change(self.vla.head.weight)
        return super().clip_grad_norm()
    def change(self, weight):
        pass
    def model_tensors(self):
        return super().model_tensors()
# the kit
from fluxvla_core.testing import TrainRunnerConformance, train_runner

train_runner.LENGTH.pop("epochs", None)

class TestSpecimen(TrainRunnerConformance):
    entry_point = "Specimen"
    ranks = 1
"""
INIT = "        super().__init__(**kwargs)\n"
LOSS = "        (self.share * loss).backward()\n"
CHANGE = "    def change(self, weight):\n        pass\n"
KILLED = "a_killed_run_goes_on_bit_for_bit"
STOPPED = "one_rank_that_is_told_to_stop_stops_all_with_all_saved"
ALONE = "it_trains_as_one_process_does_and_goes_on_there"
SCALARS = "parameters_without_dimensions_are_trained_or_refused"
FAULTS = {
    "no version": Fault("is_complete", 'api = "1.0"', "api = None", "the version of the contract"),
    "open": Fault(
        "constructor_names_every_parameter", INIT,
        '        super().__init__(**{k: v for k, v in kwargs.items() if k != "colour"})\n',
        "expected every parameter by name",
    ),
    "a mean that is not saved": Fault(
        KILLED, CHANGE,
        "    def change(self, weight):\n"
        "        self.mean = 0.5 * weight.grad + 0.5 * self.mean\n"
        "        weight.grad.copy_(self.mean)\n",
        "what the strategy keeps from one step to the next is not all in the checkpoint",
        (STOPPED, ALONE),
    ),
    "begins anew": Fault(
        KILLED, CHANGE, CHANGE + "    def resume(self):\n        return 0\n",
        "a run that was killed and resumed left other bytes", (STOPPED,),
    ),
    "stops without a word": Fault(
        STOPPED, CHANGE,
        CHANGE + "    def run(self, vla_dataset):\n"
        "        try:\n            return super().run(vla_dataset)\n"
        "        except RunFailed:\n            return None\n",
        "all of them stop at the same step, with everything saved",
    ),
    "the last batch is dropped": Fault(
        ALONE, LOSS,
        "        if self.parts == 1:\n            (self.share * loss).backward()\n",
        "the same samples in the same steps train the same",
    ),
    "names of a wrapper": Fault(
        ALONE, "        return super()._wrap_model(vla)\n",
        "        return Wrapped(super()._wrap_model(vla))\n",
        "differ in the names", (SCALARS,),
    ),
    "a seed of its own": Fault(
        "training_follows_from_its_seed", INIT,
        '        kwargs["seed"] = 42\n        super().__init__(**kwargs)\n',
        "with seed = 42 and seed = 43 the weights are the same",
    ),
    "a scalar that is not refused": Fault(
        SCALARS, "    ranks = 1\n", "    ranks = 1\n    scalars = ()\n",
        "expected a ConfigError: it is none of scalars",
    ),
    "a scalar with a dimension": Fault(
        SCALARS, "        return super().model_tensors()\n",
        "        return {n: t[None] if n == 'gain' else t "
        "for n, t in super().model_tensors().items()}\n",
        "was saved with the shape (1,), expected (): the model would not load it",
        (KILLED, STOPPED, ALONE),
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Outcomes:
    return outcomes(tmp_path_factory.mktemp("strategies"), GOOD, FAULTS, "runners")


@pytest.mark.early
def test_a_right_strategy_passes_every_check(found: Outcomes) -> None:
    check_good(found, checks=7)


@pytest.mark.parametrize("name", FAULTS)
def test_a_wrong_strategy_fails_its_own_check(found: Outcomes, name: str) -> None:
    check_fault(found, name, FAULTS[name])
