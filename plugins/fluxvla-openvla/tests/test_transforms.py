from __future__ import annotations

import numpy as np
import pytest
import torch
from fluxvla_openvla.images import (
    CenterCropOpenVLAImages,
    JitterOpenVLAColors,
    RandomCropOpenVLAImages,
    ResizeOpenVLAImages,
    crop_and_resize,
)
from fluxvla_openvla.normalize import DenormalizeOpenVLA, NormalizeOpenVLA, SampleDiffusionSteps
from fluxvla_openvla.openvla import ActionTokens
from fluxvla_openvla.prompts import ProcessOpenVLAPrompts
from fluxvla_openvla.vision import for_dino

from fluxvla_core import build_transform_from_cfg
from fluxvla_core.data import Pipeline
from fluxvla_core.errors import ConfigError
from tests.oracles import fill

from . import tiny

ROW = {
    "q01": [-0.5, 0.0, 0.0],
    "q99": [0.5, 2.0, 0.0],
    "min": [-1.0, -1.0, 0.3],
    "max": [1.0, 3.0, 0.3],
}
STATS = {"action": {**ROW, "mask": [True, True, True]}, "proprio": ROW}


class Words:
    """One token a word; unknown ones are equal."""

    pad_token_id = 90

    def encode(self, text):
        return [1, *(3 + len(word) for word in text.split())]


def random_image(height=48, width=64):
    return fill.integers("picture", (height, width, 3), 256).astype(np.uint8).transpose(2, 0, 1)


def test_images_equal_the_published_processors():
    expected = tiny.golden("processor")["pixel_values"]
    pipeline = Pipeline([ResizeOpenVLAImages(28), {"type": "SimpleNormalizeImages"}])
    found = torch.from_numpy(pipeline({"images": [random_image()]})["images"])
    both = torch.cat([for_dino(found[None])[0], found])
    np.testing.assert_allclose(both, expected, rtol=0, atol=1e-6)


def planes(array):
    return np.ascontiguousarray(array.transpose(2, 0, 1))


def levels(found, expected):
    """By how many of 255 levels two images differ: on average, and at most."""
    gap = np.abs(found.astype(int) - expected)
    return gap.mean(), gap.max()


def test_crops_and_colours_equal_tensorflows():
    golden = {name: planes(array) for name, array in tiny.golden("tensorflow").items()}
    side = 0.9**0.5
    begin = (1 - side) / 2
    for name, top, left in (("middle", begin, begin), ("corner", 0.01, 0.04)):
        mean, most = levels(crop_and_resize(golden["lanczos"], top, left, side), golden[name])
        # The order of sums differs in the last bit, and 255.5 is cut off.
        assert (mean < 0.01, most <= 1) == (True, True), name

    class Drawn:
        def __init__(self):
            self.values = iter((0.1, 0.15, -0.15, -0.04))

        def uniform(self, low, high):
            return next(self.values)

    found = JitterOpenVLAColors()({"images": [golden["lanczos"]]}, Drawn())["images"]
    mean, most = levels(found, golden["jittered"])
    assert (mean < 0.01, most <= 1) == (True, True)


def test_lanczos_is_tensorflows_up_to_single_levels():
    golden = {name: planes(array) for name, array in tiny.golden("tensorflow").items()}
    found = ResizeOpenVLAImages(28, "lanczos")({"images": [golden["smooth"]]})["images"]
    mean, most = levels(found, golden["lanczos"])
    assert (mean < 0.2, most <= 1) == (True, True)


def test_a_crop_of_everything_changes_nothing():
    image = random_image(20, 28)
    assert np.array_equal(crop_and_resize(image, 0.0, 0.0, 1.0), image)


def test_a_crop_keeps_a_linear_ramp_linear():
    ramp = np.tile(np.linspace(10, 240, 24), (3, 24, 1)).astype(np.uint8)
    found = crop_and_resize(ramp, 0.25, 0.25, 0.5)
    inside = np.linspace(10 + 230 * 0.25, 10 + 230 * 0.75, 24)
    assert np.abs(found[0, 7] - inside).max() <= 1.0


def test_training_crops_at_random_and_acting_in_the_middle():
    pipeline = Pipeline([RandomCropOpenVLAImages(0.9), CenterCropOpenVLAImages(0.9)])
    rng = np.random.default_rng(0)
    sample = {"images": [random_image(28, 28)]}
    first, second = (pipeline(sample, rng) for _ in range(2))
    middle = pipeline.inference()(sample)
    side = 0.9**0.5
    assert np.array_equal(
        middle["images"],
        crop_and_resize(random_image(28, 28), (1 - side) / 2, (1 - side) / 2, side),
    )
    assert not np.array_equal(first["images"], second["images"])
    assert first.keys() == middle.keys() == {"images"}


def test_colours_without_change_stay_and_grey_has_no_hue():
    rng = np.random.default_rng(0)
    image = random_image(8, 8)
    same = JitterOpenVLAColors(0.0, 0.0, 0.0, 0.0)({"images": [image]}, rng)["images"]
    assert np.abs(same.astype(int) - image).max() <= 1
    grey = np.repeat(image[:1], 3, 0)
    turned = JitterOpenVLAColors(0.0, 0.0, 0.5, 0.5)({"images": [grey]}, rng)["images"]
    assert np.abs(turned.astype(int) - grey).max() <= 1


def test_half_a_turn_of_the_hue_gives_the_opposite_colour():
    class Half:
        def uniform(self, low, high):
            return high

    red = np.zeros((3, 2, 2), np.uint8)
    red[0] = 200
    found = JitterOpenVLAColors(0.0, 0.0, 0.0, 0.5)({"images": [red]}, Half())["images"]
    assert found[:, 0, 0].tolist() == [0, 200, 200]


def test_the_prompt_is_openvlas_and_ends_in_the_empty_token():
    seen = []

    class Listening(Words):
        def encode(self, text):
            seen.append(text)
            return super().encode(text)

    process = ProcessOpenVLAPrompts(Listening(), max_len=16)
    found = process({"task_description": "Pick UP the cup"})
    assert seen == ["In: What action should the robot take to pick up the cup?\nOut:"]
    assert found["lang_masks"].sum() == 16 - (found["lang_tokens"] == 90).sum()
    assert found["lang_tokens"][found["lang_masks"]][-1] == 29871
    assert found["lang_tokens"][0] == 1


def test_prompts_that_cannot_be():
    process = ProcessOpenVLAPrompts(Words(), max_len=8)
    with pytest.raises(ConfigError, match="has 15 tokens, max_len is 8"):
        process({"task_description": "pick up the cup"})
    with pytest.raises(ConfigError, match="there is no instruction"):
        process({"task_description": " "})

    class Bare(Words):
        def encode(self, text):
            return super().encode(text)[1:]

    with pytest.raises(ConfigError, match=r"first token is 6, not 1 \(<s>\)"):
        ProcessOpenVLAPrompts(Bare())({"task_description": "pick up"})


def test_actions_are_scaled_clipped_and_masked():
    normalize = NormalizeOpenVLA(states=True)
    found = normalize(
        {
            "stats": STATS,
            "states": np.array([0.25, 4.0, 0.3], np.float32),
            "actions": np.array([[0.25, 1.0, 0.3], [9.0, -9.0, 0.3]], np.float32),
        }
    )
    # The third never moved in the data, the last values are beyond the quantiles.
    np.testing.assert_allclose(found["states"], [0.5, 1.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(found["actions"], [[0.5, 0.0, 0.0], [1.0, -1.0, 0.0]], atol=1e-6)
    assert found["actions"].dtype == found["states"].dtype == np.float32


@pytest.mark.parametrize("bounds", ["quantile", "min_max"])
def test_what_is_inside_the_bounds_comes_back(bounds):
    normalize = NormalizeOpenVLA(bounds, states=False, action_mask=[True, False, True])
    actions = np.array([[0.4, 17.0, 0.3], [-0.5, -4.0, 0.3]])
    found = normalize({"stats": STATS, "actions": actions, "states": np.zeros(9)})
    assert np.array_equal(found["states"], np.zeros(9))
    undo = normalize.denormalizer({"private": STATS})
    back = undo({"action": found["actions"][None]})
    np.testing.assert_allclose(back[:, :2], actions[:, :2], atol=1e-6)
    # 'quantile' of this row says 0 for the third, 'min_max' 0.3.
    np.testing.assert_allclose(back[:, 2], 0.0 if bounds == "quantile" else 0.3, atol=1e-6)


def test_liberos_gripper_is_turned_round_and_back():
    stats = {"action": {**{k: [-1.0, -1.0] for k in ("q01", "min")}, "mask": [True, False]}}
    stats["action"] |= {k: [1.0, 1.0] for k in ("q99", "max")}
    normalize = NormalizeOpenVLA(states=False, gripper="libero")
    actions = np.array([[0.1, -1.0], [0.1, 1.0]])
    found = normalize({"stats": stats, "actions": actions})["actions"]
    assert found[:, 1].tolist() == [1.0, 0.0]
    undo = normalize.denormalizer({"private": stats})
    found[:, 1] += [-0.3, 0.2]
    assert undo({"action": found})[:, 1].tolist() == [-1.0, 1.0]


def test_an_unknown_unnorm_key_lists_the_known_ones():
    with pytest.raises(ConfigError, match="no statistics 'berkeley'; there are 'bridge', 'droid'"):
        DenormalizeOpenVLA({"droid": STATS, "bridge": STATS}, statistic_name="berkeley")
    with pytest.raises(ConfigError, match="there are none"):
        DenormalizeOpenVLA()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"actions": np.zeros((2, 4))}, r"actions have shape \(2, 4\), the statistics describe 3"),
        ({"stats": {"action": ROW}}, "statistics of 'proprio' lack q01, q99, min, max"),
        (
            {"stats": {**STATS, "action": {**ROW, "mask": [True]}}},
            "'action' are not rows of one length: 3 in 'q01', .* 1 in 'mask'",
        ),
        (
            {"stats": {**STATS, "action": {**ROW, "relative": [1, 1, 0]}}},
            "count actions from the state",
        ),
    ],
)
def test_statistics_that_do_not_fit(change, words):
    sample = {"stats": STATS, "states": np.zeros(3), "actions": np.zeros((2, 3)), **change}
    with pytest.raises(ConfigError, match=words):
        NormalizeOpenVLA()(sample)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"type": "NormalizeOpenVLA", "bounds": "q"}, "bounds 'q' is not one of quantile, min_max"),
        ({"type": "NormalizeOpenVLA", "gripper": "x"}, "gripper 'x' is not one of libero"),
        ({"type": "ResizeOpenVLAImages", "interpolation": "area"}, "one of bicubic, lanczos"),
        ({"type": "CenterCropOpenVLAImages", "area": 0.0}, "area must be above 0"),
        ({"type": "JitterOpenVLAColors", "contrast": 1.0}, "contrast and saturation below 1"),
        ({"type": "SampleDiffusionSteps", "num_steps": 0}, "num_steps must be at least 1"),
    ],
)
def test_parameters_that_cannot_be(table, words):
    with pytest.raises(ConfigError, match=words):
        build_transform_from_cfg(table)


def test_steps_of_diffusion_are_whole_and_below_their_number():
    rng = np.random.default_rng(0)
    draw = SampleDiffusionSteps(4)
    steps = [draw({"actions": np.zeros((2, 3))}, rng)["time"] for _ in range(200)]
    assert np.array_equal(np.unique(steps), [0, 1, 2, 3])
    assert draw({"actions": np.zeros((2, 3))}, rng)["noise"].shape == (1, 2, 3)


def test_action_tokens_are_numpys_bins():
    tokens = ActionTokens(32000)
    edges = np.linspace(-1, 1, 256)
    values = np.concatenate([edges, np.linspace(-1.3, 1.3, 1001)])
    expected = 32000 - np.digitize(np.clip(values, -1, 1), edges)
    assert np.array_equal(tokens.encode(torch.from_numpy(values)).numpy(), expected)
    assert (expected.min(), expected.max()) == (31744, 31999)
    inside = torch.linspace(-1, 1, 999)
    assert (tokens.decode(tokens.encode(inside)) - inside).abs().max() <= 1 / 255 + 1e-6
