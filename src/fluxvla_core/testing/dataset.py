"""Conformance tests for datasets that are trained on, which a plugin inherits.

    from fluxvla_core.testing import DatasetConformance

    class TestMyDataset(DatasetConformance):
        entry_point = "MyDataset"
        arguments = {"folder": "tests/data"}

pytest collects the inherited tests. That a run can be resumed bit for bit, and that any number of
processes and workers sees the same samples, follows from what they check.
"""

from __future__ import annotations

import copy
import random
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import pytest

from fluxvla_core.contracts.contract import implements
from fluxvla_core.contracts.runner import SilentReporter
from fluxvla_core.contracts.training import Dataset
from fluxvla_core.data.sampler import SampleKey
from fluxvla_core.spec import EmbodimentSpec
from fluxvla_core.testing._conformance import (
    Conformance,
    as_array,
    calling,
    capability,
    equal,
    is_json,
    unequal_keys,
)

EPOCHS = (0, 1)


class DatasetConformance(Conformance):
    """Inherit, set ``entry_point`` and ``arguments``, and run pytest."""

    registry = "datasets"
    listed: ClassVar[tuple[str, ...]] = ()
    """Keys of a sample whose arrays may differ in shape: the collator's ``meta_keys``."""

    @pytest.fixture
    def dataset(self) -> Dataset:
        """A new dataset, prepared."""
        return self.prepared()

    def prepared(self) -> Dataset:
        """A new dataset after ``prepare``."""
        dataset = Dataset.adapt(self.make())
        dataset.prepare(SilentReporter())
        return dataset

    def indices(self, dataset: Dataset) -> tuple[int, ...]:
        """Indices of the samples that are compared: the first ones, one in the middle, the last."""
        length = len(dataset)
        return tuple(sorted({0, min(1, length - 1), length // 2, length - 1}))

    def samples(self, dataset: Dataset, epoch: int = 0) -> dict[int, dict[str, Any]]:
        """Index -> sample."""
        return {index: self.sample(dataset, index, epoch) for index in self.indices(dataset)}

    def sample(self, dataset: Dataset, index: int, epoch: int) -> dict[str, Any]:
        """One sample, by whichever of the two methods the class has."""
        one = implements(dataset, Dataset, "get_sample")
        what = f"{self.entry_point}.{'get_sample' if one else 'get_samples'}()"
        hint = f"len() is {len(dataset)}, expected a sample for each index below it in every epoch"
        with calling(what, {"index": index, "epoch": epoch}, hint):
            if one:
                return dataset.get_sample(index, epoch)
            return dataset.get_samples([SampleKey(epoch, index)])[0]

    def test_it_has_samples(self, dataset: Dataset) -> None:
        length = len(dataset)
        assert length > 0, f"len() is {length}, expected samples: give it data in arguments"
        sample = self.sample(dataset, 0, 0)
        assert isinstance(sample, dict), (
            f"get_sample(0, 0) gave a {type(sample).__name__}, expected a dict: transforms and the "
            "collator read it by keys"
        )

    def test_samples_can_be_stacked(self, dataset: Dataset) -> None:
        samples = self.samples(dataset)
        (first, sample), *others = samples.items()
        for index, other in others:
            differ = set(sample) ^ set(other)
            assert not differ, (
                f"samples {first} and {index} differ in the keys {sorted(differ)}, expected the "
                "same keys in all: a batch is made of their values, key by key"
            )
            for key in sorted(set(sample) - set(self.listed)):
                a, b = as_array(sample[key]), as_array(other[key])
                if not isinstance(a, np.ndarray):
                    continue
                assert (np.shape(a), a.dtype) == (np.shape(b), np.asarray(b).dtype), (
                    f"{key!r} of sample {first} is {a.dtype} {np.shape(a)}, of sample {index} "
                    f"{np.asarray(b).dtype} {np.shape(b)}, expected one shape and type: they are "
                    "stacked (keys that the collator only lists go into listed)"
                )

    def test_numbers_are_finite_and_not_double(self, dataset: Dataset) -> None:
        for index, sample in self.samples(dataset).items():
            for key, value in sample.items():
                array = as_array(value)
                if not isinstance(array, np.ndarray) or array.dtype.kind != "f":
                    continue
                assert array.dtype != np.float64, (
                    f"{key!r} of sample {index} is float64, expected float32: the model's weights "
                    "are, and torch multiplies no float64 with them"
                )
                assert np.isfinite(array).all(), (
                    f"{key!r} of sample {index} has numbers that are not finite, expected finite "
                    "ones: training ends at the first loss that is not"
                )

    def test_a_sample_follows_from_index_and_epoch(self, dataset: Dataset) -> None:
        first = {epoch: self.samples(dataset, epoch) for epoch in EPOCHS}
        _disturb()
        for epoch in reversed(EPOCHS):
            for index in reversed(self.indices(dataset)):
                again = self.sample(dataset, index, epoch)
                differ = unequal_keys(first[epoch][index], again)
                assert not differ, (
                    f"get_sample({index}, {epoch}) gave another {', '.join(differ)} the "
                    "second time, expected the same: draw random numbers from sample_rng(seed, "
                    "epoch, index), "
                    "so that a resumed run goes on exactly"
                )

    def test_another_process_has_the_same_samples(self, dataset: Dataset) -> None:
        first = self.samples(dataset, 1)
        _disturb()
        other = self.prepared()
        assert len(other) == len(dataset), (
            f"a second {self.entry_point} has {len(other)} samples, the first {len(dataset)}, "
            "expected as many: each process of a run has its own"
        )
        for index, sample in first.items():
            differ = unequal_keys(sample, self.sample(other, index, 1))
            assert not differ, (
                f"get_sample({index}, 1) of a second {self.entry_point} gave another "
                f"{', '.join(differ)}, expected the same: each process of a run has its own, and "
                "they share the samples by number"
            )

    def test_several_at_once_are_the_same(self, dataset: Dataset) -> None:
        indices = self.indices(dataset)
        with calling(f"{self.entry_point}.get_samples()", {"indices": indices, "epoch": 1}, "keys "
                     "have index and epoch"):  # fmt: skip
            found = dataset.get_samples([SampleKey(1, index) for index in indices])
        assert len(found) == len(indices), (
            f"get_samples() of {len(indices)} keys gave {len(found)}, expected one for each key"
        )
        for index, sample in zip(indices, found, strict=True):
            differ = unequal_keys(sample, self.sample(dataset, index, 1))
            assert not differ, (
                f"get_samples() gave another {', '.join(differ)} of sample {index} than "
                "get_sample(), expected the same: loaders use the one, validation the other"
            )

    def test_samples_belong_to_the_caller(self, dataset: Dataset) -> None:
        second = copy.deepcopy(self.sample(dataset, 0, 0))
        for key, value in self.sample(dataset, 0, 0).items():
            array = as_array(value)
            if isinstance(array, np.ndarray) and array.size and array.flags.writeable:
                array[...] = 0
                assert equal(second[key], self.sample(dataset, 0, 0)[key]), (
                    f"a change of {key!r} in one sample changed a later get_sample(0, 0), expected "
                    "fresh arrays: transforms may write into them"
                )

    def test_its_seed_can_be_set(self, dataset: Dataset) -> None:
        dataset.use_seed(123)
        first = self.samples(dataset)
        other = self.prepared()
        other.use_seed(123)
        for index, sample in first.items():
            differ = unequal_keys(sample, self.sample(other, index, 0))
            assert not differ, (
                f"after use_seed(123) get_sample({index}, 0) gave another {', '.join(differ)} than "
                "in a second dataset with that seed, expected the same: runs are repeated by it"
            )

    # -- what a checkpoint takes from it -----------------------------------------------------------

    def test_its_statistics_fit_its_samples(self, dataset: Dataset) -> None:
        own = implements(dataset, Dataset, "statistics")
        capability(own, "statistics would hold what actions are normalised by, for checkpoints")
        statistics, sample = dataset.statistics, self.sample(dataset, 0, 0)
        assert is_json(statistics), (
            f"statistics hold {statistics!r:.200}, expected JSON values alone (lists, no arrays): "
            "they go into every checkpoint"
        )
        name = dataset.statistic_name
        assert name is None or name in statistics, (
            f"statistic_name is {name!r}, and statistics have {', '.join(statistics)}, expected "
            "one of these: a checkpoint is denormalised by that entry"
        )
        for entry, key in (("action", "actions"), ("proprio", "states")):
            width = np.shape(sample[key])[-1] if key in sample else None
            for title, table in statistics.items():
                mean = table.get(entry, {}).get("mean")
                if mean is None or width is None:
                    continue
                have = np.shape(mean)[-1]
                assert have == width, (
                    f"statistics[{title!r}][{entry!r}] describe {have} numbers, and {key!r} of a "
                    f"sample have {width}, expected as many: each is normalised by its own"
                )

    def test_it_says_which_robot_its_actions_are_for(self, dataset: Dataset) -> None:
        spec = dataset.embodiment
        own = spec is not None
        capability(own, "embodiment would say which robot its actions are for; checkpoints need it")
        assert isinstance(spec, EmbodimentSpec), (
            f"embodiment is a {type(spec).__name__}, expected an EmbodimentSpec"
        )
        actions = self.sample(dataset, 0, 0).get("actions")
        width = None if actions is None else np.shape(actions)[-1]
        assert width is None or width >= spec.dim, (
            f"embodiment has {spec.dim} joints, and an action of a sample {width} numbers, "
            "expected one for each joint: a robot would be sent too few"
        )
        fps = dataset.fps
        assert isinstance(fps, (int, float)), (
            f"fps is {fps!r}, expected a positive number: without the rate of its actions a policy "
            "cannot drive a robot"
        )
        assert 0 < fps < float("inf"), f"fps is {fps}, expected a positive, finite number"

    def test_episodes_end_where_it_says(self, dataset: Dataset) -> None:
        ends = dataset.episode_ends
        capability(ends is not None, "episode_ends would allow shuffle_episodes")
        rows = np.asarray(ends)
        whole = len(rows) > 0 and rows[-1] == len(dataset)
        assert whole and bool((np.diff(rows) > 0).all()), (  # noqa: PT018 - one rule
            f"episode_ends is {rows.tolist()[:8]}, and there are {len(dataset)} samples, expected "
            "rising indices, the last of them the number of samples: shuffling would lose some"
        )


def _disturb() -> None:
    """Leave the global generators elsewhere, as other code of a process does."""
    random.seed(987)
    np.random.seed(987)


def keys_of(sample: Mapping[str, Any]) -> tuple[str, ...]:
    """Keys of a sample whose values are arrays, for a collator's ``keys``."""
    return tuple(key for key, value in sample.items() if isinstance(as_array(value), np.ndarray))
