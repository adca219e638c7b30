"""Conformance tests for transforms, which a plugin inherits.

    from fluxvla_core.testing import TransformConformance

    class TestMyTransform(TransformConformance):
        entry_point = "MyTransform"

pytest collects the inherited tests. The same transforms prepare training samples and a robot's
observations; what they check keeps the two alike, and a resumed run exact.
"""

from __future__ import annotations

import copy
import random
from typing import Any, ClassVar

import numpy as np
import pytest

from fluxvla_core.contracts.contract import implements
from fluxvla_core.contracts.frame import Sample
from fluxvla_core.contracts.training import Transform
from fluxvla_core.testing._conformance import (
    Conformance,
    calling,
    capability,
    equal,
    raised,
    unequal_keys,
)

SEED = 5
# Keys that a robot's observation does not have.
_LEARNT_FROM = ("actions", "action_masks", "timestamp", "sample_ids", "info")
_CLOSE = 1e-4


class TransformConformance(Conformance):
    """Inherit, set ``entry_point`` and ``arguments``, and run pytest."""

    registry = "transforms"
    state_dim: ClassVar[int] = 7
    """Numbers of a state and of an action."""
    horizon: ClassVar[int] = 4
    """Actions of a chunk."""
    cameras: ClassVar[int] = 2
    """Images of a sample."""
    image_size: ClassVar[tuple[int, int]] = (24, 32)
    """Height and width of an image."""
    draws: ClassVar[bool] = True
    """Whether one with ``needs_rng`` gives another result with another generator."""

    @pytest.fixture
    def transform(self) -> Transform:
        """A new transform."""
        return Transform.adapt(self.make())

    def sample(self, number: int = 0) -> Sample:
        """Sample ``number`` as ``ParquetDataset`` hands it to its first transform.

        Override it for a transform that comes after others.
        """
        rng = np.random.default_rng(number)
        dim, height, width = self.state_dim, *self.image_size
        entry = {
            "mean": [0.1] * dim, "std": [0.5] * dim, "min": [-2.0] * dim, "max": [2.0] * dim,
            "q01": [-1.5] * dim, "q10": [-1.0] * dim, "q50": [0.0] * dim, "q90": [1.0] * dim,
            "q99": [1.5] * dim, "count": [100],
        }  # fmt: skip
        return {
            "states": rng.uniform(-1, 1, dim).astype(np.float32),
            "actions": rng.uniform(-1, 1, (self.horizon, dim)).astype(np.float32),
            "action_masks": np.ones(self.horizon, np.float32),
            "task_description": "pick up the red cup",
            "timestamp": np.asarray(0.1 * number, np.float32),
            "sample_ids": np.asarray(number, np.int64),
            "stats": {"proprio": copy.deepcopy(entry), "action": copy.deepcopy(entry)},
            "info": {"dataset": "data", "episode_index": 0, "frame_index": number},
            "images": [
                rng.integers(0, 256, (3, height, width), np.uint8) for _ in range(self.cameras)
            ],
            "img_masks": np.ones(self.cameras, np.bool_),
        }

    def observation(self, number: int = 0) -> Sample:
        """The keys of ``sample`` that a robot has."""
        return {k: v for k, v in self.sample(number).items() if k not in _LEARNT_FROM}

    def apply(self, transform: Any, sample: Sample, seed: int = SEED) -> Sample:
        """Call it as the pipeline does."""
        hint = (
            "set state_dim, horizon, cameras and image_size of this kit's subclass to what it "
            "takes, or override sample(number) for one that comes after other transforms (fluxvla "
            "plugins check: --kit FILE with such a subclass)"
        )
        with calling(self.entry_point, dict(sample), hint):
            return self._apply(transform, sample, seed)

    def _apply(self, transform: Any, sample: Sample, seed: int = SEED) -> Sample:
        if transform.needs_rng:
            result: Sample = transform(sample, np.random.default_rng(seed))
        else:
            result = transform(sample)
        return result

    def test_it_gives_a_sample(self, transform: Transform) -> None:
        found = self.apply(transform, self.sample())
        assert isinstance(found, dict), (
            f"called with a sample it gave a {type(found).__name__}, expected the sample, a dict: "
            "the next transform takes it"
        )

    def test_what_it_was_given_is_untouched(self, transform: Transform) -> None:
        given, kept = self.sample(), self.sample()
        values = dict(given)  # it may give a key another value
        self.apply(transform, given)
        changed = [key for key in kept if not equal(values[key], kept[key])]
        assert not changed, (
            f"it wrote into {', '.join(changed)} of the sample that it was given, expected new "
            "arrays: a dataset hands out its own, and the next epoch would see them changed again"
        )

    def test_a_result_does_not_depend_on_earlier_samples(self, transform: Transform) -> None:
        first = copy.deepcopy(self.apply(transform, self.sample()))
        self.apply(transform, self.sample(1), SEED + 1)
        differ = unequal_keys(first, self.apply(transform, self.sample()))
        assert not differ, (
            f"the same sample gave another {', '.join(differ)} after another sample, expected the "
            "same: samples come in any order, and each worker has a transform of its own"
        )

    def test_random_numbers_come_from_its_generator(self, transform: Transform) -> None:
        results = []
        for seed in (1, 2):
            random.seed(seed)
            np.random.seed(seed)
            results.append(copy.deepcopy(self.apply(transform, self.sample())))
        differ = unequal_keys(*results)
        assert not differ, (
            f"{', '.join(differ)} follow from the global generator of numpy or Python, expected "
            "the one that it is given: with needs_rng = True it is called with (sample, rng), and "
            "a resumed run draws the same"
        )

    def test_another_generator_gives_another_result(self, transform: Transform) -> None:
        capability(transform.needs_rng, "needs_rng = True is for a transform that draws")
        capability(self.draws, "draws is False here")
        results = [self.apply(transform, self.sample(), seed) for seed in range(8)]
        assert any(unequal_keys(results[0], other) for other in results[1:]), (
            "eight generators gave the same result, expected others: needs_rng is True, and the "
            "generator is not used (set draws = False if that is meant)"
        )

    def test_a_robot_can_use_it(self, transform: Transform) -> None:
        capability(not transform.training_only, "training_only = True: robots do not use it")
        assert not transform.needs_rng, (
            "it draws random numbers (needs_rng) and training_only is False, expected True: on a "
            "robot there is no generator, and the pipeline refuses it"
        )
        problem = ""
        try:
            self._apply(transform, self.observation())
        except Exception as error:  # noqa: BLE001 - said in the assertion
            problem = raised(error)
        assert not problem, (
            f"called with a robot's observation, which has {', '.join(self.observation())}, it "
            f"raised {problem}; expected a result: only training has actions; leave alone what is "
            "not there, or say training_only = True"
        )

    def test_training_and_robot_see_the_same(self, transform: Transform) -> None:
        capability(not transform.training_only, "training_only = True: robots do not use it")
        capability(not transform.needs_rng, "it draws random numbers")
        trained = self.apply(transform, self.sample())
        acted = self.apply(transform, self.observation())
        common = {key: value for key, value in trained.items() if key in acted}
        differ = unequal_keys(common, {key: acted[key] for key in common})
        assert not differ, (
            f"{', '.join(differ)} of a robot's observation differ from those of the training "
            "sample that has them too, expected the same: the policy would see what it never learnt"
        )

    def test_it_keeps_images_if_it_says_so(self, transform: Transform) -> None:
        capability(transform.keeps_images, "keeps_images = True would let images be normalised on "
                   "the device")  # fmt: skip
        given = {key: value for key, value in self.sample().items() if key != "images"}
        problem = ""
        try:
            self._apply(transform, given)
        except Exception as error:  # noqa: BLE001 - said in the assertion
            problem = raised(error)
        assert not problem, (
            f"keeps_images is True, and without 'images' it raised {problem}, expected no use of "
            "them: they may be normalised after it"
        )
        kept = self.apply(transform, self.sample())["images"]
        assert equal(kept, self.sample()["images"]), (
            "keeps_images is True, and it changed the images, expected them as they were: they "
            "may be normalised after it"
        )

    def test_its_normalisation_can_be_undone(self, transform: Transform) -> None:
        own = implements(transform, Transform, "denormalizer")
        capability(own, "one that normalises actions defines denormalizer(norm_stats, name)")
        sample = self.sample()
        normalised = self.apply(transform, self.sample())["actions"]
        undo = transform.denormalizer({"private": sample["stats"]}, "private")
        found = undo({"action": np.asarray(normalised)[None], "states": sample["states"]})
        found = np.asarray(found)[:, : self.state_dim]
        gap = float(np.abs(found - sample["actions"]).max())
        assert gap < _CLOSE, (
            f"what denormalizer() gives differs by {gap:.3g} from the actions that were "
            "normalised, expected the same: a robot would be sent other actions than it was shown"
        )
