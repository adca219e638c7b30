"""The kit of transforms: right ones pass, and each wrong one fails its own check in words."""

from __future__ import annotations

import pytest

from fluxvla_core.testing import TransformConformance

from .specimens import Fault, Outcomes, check_fault, check_good, outcomes

GOOD = '''
import numpy as np
from fluxvla_core import TRANSFORMS, Transform
from fluxvla_core.testing import TransformConformance

@TRANSFORMS.register_module()
class Specimen(Transform):
    """Normalises actions and states, or adds noise to states."""
    api = "1.0"
    keeps_images = True
    def __init__(self, scale: float = 2.0):
        self.scale = scale
    def __call__(self, sample):
        found = {**sample, "states": sample["states"] / np.float32(self.scale)}
        if "actions" in sample:
            found["actions"] = sample["actions"] / np.float32(self.scale)
        return found
    def denormalizer(self, norm_stats, statistic_name):
        return lambda data: data["action"][0] * self.scale

class TestSpecimen(TransformConformance):
    entry_point = "Specimen"
'''
FOUND = "        return found\n"
FAULTS = {
    "no version": Fault("is_complete", '    api = "1.0"\n', "", "the version of the contract"),
    "nothing": Fault(
        "it_gives_a_sample", FOUND, "        sample.update(found)\n", "gave a NoneType",
        ("a_result_does_not_depend_on_earlier_samples", "random_numbers_come_from_its_generator",
         "training_and_robot_see_the_same", "it_keeps_images_if_it_says_so",
         "its_normalisation_can_be_undone"),
    ),
    "another width": Fault(
        "it_gives_a_sample", FOUND, '        found["states"].reshape(2, 7)\n' + FOUND,
        "it was given states (7,) float32, actions (4, 7) float32",
        ("what_it_was_given_is_untouched", "a_result_does_not_depend_on_earlier_samples",
         "random_numbers_come_from_its_generator", "a_robot_can_use_it",
         "training_and_robot_see_the_same", "it_keeps_images_if_it_says_so",
         "its_normalisation_can_be_undone"),
    ),
    "in place": Fault(
        "what_it_was_given_is_untouched", FOUND, '        sample["states"] *= 0.9\n' + FOUND,
        "wrote into states",
    ),
    "remembers": Fault(
        "a_result_does_not_depend_on_earlier_samples", FOUND,
        '        last = getattr(self, "last", 0.0)\n'
        '        self.last = float(found["states"][0])\n'
        '        found["states"] = found["states"] + np.float32(1e-3 * last)\n' + FOUND,
        "samples come in any order",
        ("random_numbers_come_from_its_generator", "training_and_robot_see_the_same"),
    ),
    "global generator": Fault(
        "random_numbers_come_from_its_generator", FOUND,
        '        found["states"] = found["states"] + np.float32(np.random.normal())\n' + FOUND,
        "the global generator",
        ("a_result_does_not_depend_on_earlier_samples", "training_and_robot_see_the_same"),
    ),
    "an idle generator": Fault(
        "another_generator_gives_another_result", "    def __call__(self, sample):",
        "    needs_rng, training_only = True, True\n    def __call__(self, sample, rng):",
        "the generator is not used",
    ),
    "random on a robot": Fault(
        "a_robot_can_use_it", "    def __call__(self, sample):",
        "    needs_rng = True\n    def __call__(self, sample, rng):\n"
        '        sample = {**sample, "states": sample["states"] + np.float32(rng.normal())}',
        "on a robot there is no generator",
    ),
    "needs actions": Fault(
        "a_robot_can_use_it", '        if "actions" in sample:\n            found',
        "        if True:\n            found", "only training has actions",
        ("training_and_robot_see_the_same",),
    ),
    "another state on a robot": Fault(
        "training_and_robot_see_the_same", FOUND,
        '        if "actions" not in sample: found["states"] = found["states"] + np.float32(1)\n'
        + FOUND,
        "would see what it never learnt",
    ),
    "reads images": Fault(
        "it_keeps_images_if_it_says_so", FOUND, '        len(sample["images"])\n' + FOUND,
        "without 'images' it raised KeyError: 'images' (specimen_",
    ),
    "changes images": Fault(
        "it_keeps_images_if_it_says_so", FOUND,
        '        found["images"] = [255 - i for i in sample.get("images", ())]\n' + FOUND,
        "changed the images",
    ),
    "undone otherwise": Fault(
        "its_normalisation_can_be_undone", '["action"][0] * self.scale',
        '["action"][0] * self.scale + 0.1', "a robot would be sent other actions",
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Outcomes:
    return outcomes(tmp_path_factory.mktemp("transforms"), GOOD, FAULTS)


def test_a_right_transform_passes_every_check(found: Outcomes) -> None:
    check_good(found, checks=9)


@pytest.mark.parametrize("name", FAULTS)
def test_a_wrong_transform_fails_its_own_check(found: Outcomes, name: str) -> None:
    check_fault(found, name, FAULTS[name])


class TestNormalizeStatesAndActions(TransformConformance):
    entry_point = "NormalizeStatesAndActions"
    arguments = {"norm_type": "mean_std"}  # noqa: RUF012


class TestResizeImages(TransformConformance):
    entry_point = "ResizeImages"
    arguments = {"height": 12, "width": 16}  # noqa: RUF012


class TestRandomShiftImages(TransformConformance):
    entry_point = "RandomShiftImages"
    arguments = {"pixels": 4}  # noqa: RUF012


class TestSampleFlowNoise(TransformConformance):
    entry_point = "SampleFlowNoise"


class TestStateNoise(TransformConformance):
    entry_point = "StateNoise"
    arguments = {"std": 0.1}  # noqa: RUF012
