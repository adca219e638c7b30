"""The kit of datasets: a right one passes, and each wrong one fails its own check in words."""

from __future__ import annotations

import pytest

from .specimens import Fault, Outcomes, check_fault, check_good, outcomes

GOOD = """
import numpy as np
from fluxvla_core import DATASETS, Dataset, EmbodimentSpec, Joint
from fluxvla_core.data import sample_rng
from fluxvla_core.testing import DatasetConformance

JOINTS = tuple(Joint(f"j{n}", "rad", -2.0, 2.0, 1.0, 4.0) for n in range(3))
ENTRY = {"mean": [0.0] * 3, "std": [1.0] * 3}

@DATASETS.register_module()
class Specimen(Dataset):
    api = "1.0"
    embodiment, fps, statistic_name = EmbodimentSpec("arm", JOINTS, (), 10.0), 10.0, "private"
    statistics = {"private": {"action": ENTRY, "proprio": ENTRY}}
    episode_ends = np.array([4, 9])
    def __init__(self, seed: int = 0):
        self.seed = seed
        self.rows = np.random.default_rng(0).normal(size=(9, 3)).astype(np.float32)
    def __len__(self):
        return 9
    def use_seed(self, seed):
        self.seed = seed
    def get_sample(self, index, epoch):
        noise = sample_rng(self.seed, epoch, index).normal(size=3)
        return {"states": self.rows[index] + noise.astype(np.float32),
                "actions": np.repeat(self.rows[index][None], 4, 0),
                "sample_ids": np.asarray(index, np.int64), "task_description": "wave"}

class TestSpecimen(DatasetConformance):
    entry_point = "Specimen"
"""
NOISE = "noise = sample_rng(self.seed, epoch, index).normal(size=3)"
REPEATED = (
    "another_process_has_the_same_samples", "several_at_once_are_the_same", "its_seed_can_be_set",
    "samples_belong_to_the_caller",
)  # fmt: skip
FAULTS = {
    "no version": Fault("is_complete", '    api = "1.0"\n', "", "the version of the contract"),
    "a list": Fault(
        "it_has_samples", '"task_description": "wave"}', '"task_description": "wave"}.items()',
        "gave a dict_items, expected a dict",
        ("samples_can_be_stacked", "numbers_are_finite_and_not_double",
         "a_sample_follows_from_index_and_epoch", *REPEATED,
         "it_says_which_robot_its_actions_are_for"),
    ),
    "too few": Fault(
        "samples_can_be_stacked", "normal(size=(9, 3))", "normal(size=(8, 3))",
        "it was given index 8, epoch 0: len() is 9, expected a sample for each index below it",
        ("numbers_are_finite_and_not_double", "a_sample_follows_from_index_and_epoch",
         "another_process_has_the_same_samples", "several_at_once_are_the_same",
         "its_seed_can_be_set"),
    ),
    "a key that comes and goes": Fault(
        "samples_can_be_stacked", '"task_description": "wave"}',
        '"task_description": "wave", **({"depth": 1.0} if index else {})}', "differ in the keys",
    ),
    "ragged": Fault(
        "samples_can_be_stacked", "[None], 4, 0)", "[None], 4 if index < 8 else 3, 0)",
        "expected one shape and type",
    ),
    "double": Fault(
        "numbers_are_finite_and_not_double", "noise.astype(np.float32)", "noise",
        "is float64, expected float32",
    ),
    "not finite": Fault(
        "numbers_are_finite_and_not_double", "np.repeat(self.rows[index][None], 4, 0)",
        "np.repeat(self.rows[index][None], 4, 0) / np.float32(index != 8)", "not finite",
    ),
    "one generator": Fault(
        "a_sample_follows_from_index_and_epoch", NOISE,
        'self.rng = getattr(self, "rng", None) or np.random.default_rng(0); '
        "noise = self.rng.normal(size=3)",
        "sample_rng(seed, epoch, index)",
        ("several_at_once_are_the_same", "samples_belong_to_the_caller"),
    ),
    "global generator": Fault(
        "a_sample_follows_from_index_and_epoch", NOISE, "noise = np.random.normal(size=3)",
        "sample_rng(seed, epoch, index)", REPEATED,
    ),
    "each its own": Fault(
        "another_process_has_the_same_samples", "        self.seed = seed\n        self.rows",
        "        self.seed = seed + np.random.default_rng().integers(1 << 40)\n        self.rows",
        "each process of a run has its own",
    ),
    "another way for several": Fault(
        "several_at_once_are_the_same", "    def use_seed",
        "    def get_samples(self, keys):\n"
        "        return [self.get_sample(k.index, 0) for k in keys]\n    def use_seed",
        "loaders use the one",
    ),
    "its own rows": Fault(
        "samples_belong_to_the_caller", "np.repeat(self.rows[index][None], 4, 0)",
        "self.rows[:4]", "expected fresh arrays",
    ),
    "a seed of time": Fault(
        "its_seed_can_be_set", "    def use_seed(self, seed):\n        self.seed = seed",
        "    def use_seed(self, seed):\n        self.seed = np.random.default_rng().integers(1 "
        "<< 40)",
        "runs are repeated by it",
    ),
    "statistics of arrays": Fault(
        "its_statistics_fit_its_samples", '{"mean": [0.0] * 3,', '{"mean": np.zeros(3),',
        "JSON values alone",
    ),
    "statistics of others": Fault(
        "its_statistics_fit_its_samples", '{"mean": [0.0] * 3,', '{"mean": [0.0] * 2,',
        "describe 2 numbers",
    ),
    "a name of none": Fault(
        "its_statistics_fit_its_samples", '10.0, "private"', '10.0, "mine"',
        "statistic_name is 'mine'",
    ),
    "no rate": Fault(
        "it_says_which_robot_its_actions_are_for", '10.0), 10.0, "private"',
        '10.0), None, "private"', "fps is None",
    ),
    "more joints": Fault(
        "it_says_which_robot_its_actions_are_for", "for n in range(3))", "for n in range(5))",
        "embodiment has 5 joints, and an action of a sample 3 numbers",
    ),
    "ends elsewhere": Fault(
        "episodes_end_where_it_says", "np.array([4, 9])", "np.array([4, 8])", "shuffling would "
        "lose",
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Outcomes:
    return outcomes(tmp_path_factory.mktemp("datasets"), GOOD, FAULTS)


def test_a_right_dataset_passes_every_check(found: Outcomes) -> None:
    check_good(found, checks=13)


@pytest.mark.parametrize("name", FAULTS)
def test_a_wrong_dataset_fails_its_own_check(found: Outcomes, name: str) -> None:
    check_fault(found, name, FAULTS[name])
