"""The kit of metrics: right ones pass, and each wrong one fails its own check in words."""

from __future__ import annotations

import pytest

from fluxvla_core.testing import MetricConformance

from .specimens import Fault, Outcomes, check_fault, check_good, outcomes

GOOD = '''
from fluxvla_core import METRICS
from fluxvla_core.testing import MetricConformance
from fluxvla_core.training import Metric

@METRICS.register_module()
class Specimen(Metric):
    """Keeps the losses."""
    api = "1.0"
    def __init__(self, window: int = 2):
        self.window, self.losses, self.new = window, [], []
    def start(self, step, config):
        self.step = step
    def commit(self, *, global_step, epoch, loss, lr, **more):
        self.losses.append(loss)
    def push(self):
        self.new = self.losses[-1:]
    def sync(self):
        pass
    def state_dict(self):
        return {"losses": list(self.losses)}
    def load_state_dict(self, state):
        self.losses = list(state["losses"])
    def finalize(self):
        self.new = []

class TestSpecimen(MetricConformance):
    entry_point = "Specimen"
'''
FAULTS = {
    "no version": Fault("is_complete", '    api = "1.0"\n', "", "the version of the contract"),
    "fails at its end": Fault(
        "a_training_calls_it", "        pass\n", "        raise OSError('no disk')\n", "no disk",
        ("it_goes_on_from_a_checkpoint", "it_may_end_without_a_step"),
    ),
    "wants a setting": Fault(
        "a_training_calls_it", "self.step = step", 'self.step = config["runner"]["colour"]',
        "it was given step 0, config {runner {type 'MyTrainRunner', max_steps 4}}: which keys",
        ("numbers_of_any_name_are_taken", "the_record_belongs_to_the_caller",
         "its_state_goes_into_a_checkpoint", "it_goes_on_from_a_checkpoint",
         "a_state_is_not_changed_later", "it_may_end_without_a_step"),
    ),
    "writes into the config": Fault(
        "the_record_belongs_to_the_caller", "self.step = step",
        'self.step = config["runner"].pop("max_steps")', "start() changed the config",
    ),
    "knows all names": Fault(
        "numbers_of_any_name_are_taken", "        self.losses.append(loss)",
        '        self.losses.append(loss)\n        if "new" in more: raise KeyError("new")',
        "expected it to take any",
    ),
    "arrays": Fault(
        "its_state_goes_into_a_checkpoint", '{"losses": list(self.losses)}',
        '{"losses": tuple(self.losses), "all": {1: 2}}', "JSON values alone",
    ),
    "forgets": Fault(
        "it_goes_on_from_a_checkpoint", 'self.losses = list(state["losses"])', "self.losses = []",
        "a resumed run's records would differ",
    ),
    "lends its state": Fault(
        "a_state_is_not_changed_later", "list(self.losses)}", "self.losses}", "expected a copy",
        ("it_goes_on_from_a_checkpoint",),
    ),
    "wants a step": Fault(
        "it_may_end_without_a_step", "self.losses[-1:]", "[self.losses[-1]]", "IndexError",
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Outcomes:
    return outcomes(tmp_path_factory.mktemp("metrics"), GOOD, FAULTS)


def test_a_right_metric_passes_every_check(found: Outcomes) -> None:
    check_good(found, checks=9)


@pytest.mark.parametrize("name", FAULTS)
def test_a_wrong_metric_fails_its_own_check(found: Outcomes, name: str) -> None:
    check_fault(found, name, FAULTS[name])


class TestVLAMetric(MetricConformance):
    entry_point = "VLAMetric"
    arguments = {"active_trackers": ("jsonl",), "window_size": 2}  # noqa: RUF012
