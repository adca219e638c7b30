"""Images that travel as uint8 become, bit for bit, what their transform makes of them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fluxvla_core.data.loader import DictCollator
from fluxvla_core.data.transforms.images import (
    SCALE,
    NormalizeImages,
    ResizeImages,
    SimpleNormalizeImages,
    normalized,
)
from fluxvla_core.data.transforms.pipeline import Pipeline, declared, deferring
from fluxvla_core.errors import ConfigError

MEANS = [123.515625, 116.04492188, 103.59375]
STDS = [58.27148438, 57.02636719, 57.27539062]
UNIT = {"scale_to_unit_interval": True}


def random_images(seed=0, dtype=np.uint8):
    """Two cameras, as views of (H, W, 3) memory, with every value there is."""
    rng = np.random.default_rng(seed)
    values = rng.permutation(np.arange(2 * 3 * 16 * 24) % 256).astype(dtype)
    return [image.transpose(2, 0, 1) for image in values.reshape(2, 16, 24, 3)]


def by_hand(images, means, stds, unit=False):
    """The formula, operation by operation in float32."""
    x = np.concatenate(images).astype(np.float32)
    if unit:
        x = x / np.float32(255)
    means, stds = (np.array(v, np.float32).reshape(-1, 3) for v in (means, stds))
    means, stds = (np.tile(v, (2 // len(v), 1)).reshape(6, 1, 1) for v in (means, stds))
    return (x - means) / (stds + np.float32(1e-8))


def simply(images):
    x = np.concatenate(images).astype(np.float32)
    return x * np.float32(2 / 255) - np.float32(1)


EACH = ([MEANS, [1.5, 2.5, 3.5]], [STDS, [0.3, 7.0, 11.0]])
IN_UNIT = ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225])
NORMALIZERS = {
    "all cameras": (NormalizeImages(MEANS, STDS), lambda x: by_hand(x, MEANS, STDS)),
    "one a camera": (NormalizeImages(*EACH), lambda x: by_hand(x, *EACH)),
    "unit interval": (NormalizeImages(*IN_UNIT, **UNIT), lambda x: by_hand(x, *IN_UNIT, unit=True)),
    "simple": (SimpleNormalizeImages(), simply),
}


@pytest.mark.parametrize("dtype", [np.uint8, np.float32, np.float64])
@pytest.mark.parametrize("which", NORMALIZERS)
def test_the_result_is_the_transforms_own_bit_for_bit(which, dtype):
    transform, formula = NORMALIZERS[which]
    samples = [{"images": random_images(seed, dtype)} for seed in (0, 1)]
    left = [transform.defer(sample) for sample in samples]
    batch = DictCollator(["images"])(left)
    assert batch["images"].dtype == (torch.uint8 if dtype == np.uint8 else torch.float32)
    travelled = batch["images"].clone()
    out = normalized(batch)
    assert torch.equal(batch["images"], travelled), "a batch may be looked at twice"
    assert set(out) == {"images"}
    assert out["images"].dtype == torch.float32
    for sample, found in zip(samples, out["images"].numpy(), strict=True):
        here = transform(sample)["images"]
        np.testing.assert_array_equal(found.view(np.uint32), here.view(np.uint32))
        np.testing.assert_array_equal(
            here.view(np.uint32), formula(sample["images"]).view(np.uint32)
        )


def test_each_sample_of_a_batch_has_its_own_numbers():
    transforms = [transform for transform, _ in NORMALIZERS.values()]
    samples = [{"images": random_images(seed)} for seed in range(len(transforms))]
    left = [t.defer(s) for t, s in zip(transforms, samples, strict=True)]
    # A sample that some transform has made float32 of, among others that still are uint8.
    left[1] = transforms[1].defer({"images": random_images(1, np.float32)})
    found = normalized(DictCollator(["images"])(left))["images"].numpy()
    here = np.stack([t(s)["images"] for t, s in zip(transforms, samples, strict=True)])
    np.testing.assert_array_equal(found.view(np.uint32), here.view(np.uint32))


def test_a_batch_of_which_nothing_was_left_stays_as_it_is():
    batch = {"images": torch.zeros(1, 3, 2, 2), "prompt": ["a"]}
    assert normalized(batch) == batch


def test_groups_that_fit_no_number_of_cameras_are_refused_all_the_same():
    with pytest.raises(ConfigError, match="3 groups of means and stds, 2 cameras"):
        NormalizeImages([MEANS] * 3, [STDS] * 3).defer({"images": random_images()})


RESIZE = {"type": "ResizeImages", "height": 8, "width": 8}
NORMALIZE = {"type": "NormalizeImages", "means": MEANS, "stds": STDS}
AFTER = [
    {"type": "NormalizeStatesAndActions", "norm_type": "none"},
    {"type": "StateNoise", "std": 0.1},
    {"type": "SampleFlowNoise"},
]


class Brighter(NormalizeImages):
    """What it leaves to be done is not all that it does."""

    def __call__(self, sample):
        out = super().__call__(sample)
        return {**out, "images": out["images"] + 1}


class Looking(ResizeImages):
    """A transform of somebody's, after the normalisation."""


class Blind(Looking):
    keeps_images = True

    def __call__(self, sample):
        return sample


class SeeingAgain(Blind):
    def __call__(self, sample):
        return {**sample, "images": sample["images"] * 2}


def numbers():
    entry = {"mean": [0.0] * 3, "std": [1.0] * 3}
    return {
        "images": random_images(),
        "states": np.ones(3, np.float32),
        "actions": np.ones((2, 3), np.float32),
        "stats": {"proprio": entry, "action": entry},
    }


@pytest.mark.parametrize(
    ("transforms", "dtype"),
    [
        ([RESIZE, NORMALIZE, *AFTER], np.uint8),
        ([lambda sample: sample, *AFTER, {"type": "SimpleNormalizeImages"}], np.uint8),
        ([NORMALIZE, Blind(8, 8)], np.uint8),
        ([NORMALIZE, {"type": "SimpleNormalizeImages"}], np.float32),
    ],
)
def test_a_pipeline_leaves_its_last_normalisation(transforms, dtype):
    pipeline = Pipeline(transforms)
    here, left = (p(numbers(), np.random.default_rng(0)) for p in (pipeline, pipeline.deferring()))
    assert left["images"].dtype == dtype
    found = normalized(DictCollator(set(left) - {"stats"}, ["stats"])([left]))["images"][0].numpy()
    np.testing.assert_array_equal(found, here["images"])
    assert set(left) - set(here) == {SCALE}
    for key in set(here) - {"images", "stats"}:
        np.testing.assert_array_equal(left[key], here[key])


@pytest.mark.parametrize(
    "transforms",
    [
        [],
        AFTER,
        [RESIZE],
        [NORMALIZE, RESIZE],
        [NORMALIZE, lambda sample: sample],
        [NORMALIZE, Looking(8, 8)],
        [NORMALIZE, SeeingAgain(8, 8)],
        [Brighter(MEANS, STDS)],
    ],
)
def test_nothing_is_left_where_something_may_look_at_images(transforms):
    assert Pipeline(transforms).deferring() is None


def test_asking_changes_neither_the_pipeline_nor_that_of_inference():
    shared = NormalizeImages(MEANS, STDS)
    pipeline = Pipeline([shared, *AFTER])
    assert pipeline.deferring() is not None
    assert pipeline.transforms[0] is shared
    out = pipeline.inference()(numbers())
    assert out["images"].dtype == np.float32
    assert SCALE not in out


class Source:
    def get_samples(self, keys):
        return []

    def deferring(self):
        return "left"


class Wrapper:
    """Hands everything through, and changes samples on the way."""

    def __init__(self, inner):
        self._inner = inner

    def __getattr__(self, name):
        return getattr(self._inner, name)


class Changed(Source):
    def get_samples(self, keys):
        return super().get_samples(keys)


def test_only_who_makes_the_samples_can_say_that_they_may_be_left():
    assert deferring(Source()) == "left"
    assert deferring(type("Named", (Source,), {})()) == "left"
    assert deferring(Wrapper(Source())) is None
    assert deferring(Changed()) is None
    assert deferring([1]) is None
    assert declared(Blind(8, 8), "keeps_images", "__call__") is True
