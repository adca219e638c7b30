from __future__ import annotations

import numpy as np
import pytest

from fluxvla_core import build_transform_from_cfg
from fluxvla_core.data.sampler import sample_rng
from fluxvla_core.data.transforms.images import RandomShiftImages
from fluxvla_core.data.transforms.noise import SampleFlowNoise, StateNoise
from fluxvla_core.errors import ConfigError


def random_image(seed=0):
    return np.random.default_rng(seed).integers(0, 256, (3, 12, 16), dtype=np.uint8)


def test_a_shift_moves_the_image_and_repeats_its_border():
    image = random_image()
    image.flags.writeable = False
    shift = RandomShiftImages(3)
    padded = np.pad(image, ((0, 0), (3, 3), (3, 3)), mode="edge")
    seen = set()
    for index in range(60):
        out = shift({"images": [image]}, sample_rng(0, 0, index))["images"][0]
        places = [
            (y, x)
            for y in range(7)
            for x in range(7)
            if np.array_equal(out, padded[:, y : y + 12, x : x + 16])
        ]
        assert len(places) == 1
        seen.add(places[0])
    assert len(seen) > 25


def test_cameras_are_shifted_apart_and_a_stack_stays_one():
    images = np.concatenate([random_image(), random_image()])
    outs = [
        RandomShiftImages(3)({"images": images}, sample_rng(0, 0, i))["images"] for i in range(5)
    ]
    assert all(out.shape == (6, 12, 16) for out in outs)
    assert any(not np.array_equal(out[:3], out[3:]) for out in outs)
    np.testing.assert_array_equal(
        RandomShiftImages(0)({"images": images}, sample_rng(0, 0, 0))["images"], images
    )


def test_state_noise_has_its_std_in_the_chosen_units():
    states = np.zeros(20000, np.float32)
    states.flags.writeable = False
    out = StateNoise(0.05)({"states": states}, sample_rng(0, 0, 0))["states"]
    assert out.dtype == np.float32
    assert out.std() == pytest.approx(0.05, rel=0.03)
    stats = {"proprio": {"std": np.full(20000, 3.0).tolist()}}
    scaled = StateNoise(0.05, state_key="proprio")
    out = scaled({"states": states, "stats": stats}, sample_rng(0, 0, 0))["states"]
    assert out.std() == pytest.approx(0.15, rel=0.03)


@pytest.mark.parametrize(
    ("distribution", "mean"), [("beta", 0.4), ("uniform", 0.5), ("logit_normal", 0.5)]
)
def test_flow_noise_has_its_shapes_and_distribution(distribution, mean):
    cfg = {"type": "SampleFlowNoise", "repeats": 20000, "distribution": distribution}
    draw = build_transform_from_cfg(cfg)
    out = draw({"actions": np.zeros((2, 3), np.float32)}, sample_rng(0, 0, 0))
    assert out["noise"].shape == (20000, 2, 3)
    assert out["noise"].dtype == out["time"].dtype == np.float32
    assert out["noise"].std() == pytest.approx(1, rel=0.02)
    assert out["time"].shape == (20000,)
    assert out["time"].min() >= 0
    assert out["time"].max() <= 0.999
    assert out["time"].mean() == pytest.approx(mean * 0.999, abs=0.01)


def test_equal_generators_draw_equally_and_others_differ():
    draw = SampleFlowNoise(2)
    sample = {"actions": np.zeros((2, 3), np.float32)}
    first, again, other = (draw(sample, sample_rng(0, e, 5)) for e in (0, 0, 1))
    np.testing.assert_array_equal(first["noise"], again["noise"])
    np.testing.assert_array_equal(first["time"], again["time"])
    assert not np.array_equal(first["noise"], other["noise"])
    assert "noise" not in sample


@pytest.mark.parametrize(
    ("cfg", "message"),
    [
        ({"type": "RandomShiftImages", "pixels": -1}, "pixels must be at least 0, got -1"),
        ({"type": "StateNoise", "std": -0.1}, "std must be at least 0, got -0.1"),
        ({"type": "SampleFlowNoise", "repeats": 0}, "repeats must be at least 1, got 0"),
        (
            {"type": "SampleFlowNoise", "distribution": "gamma"},
            "distribution 'gamma' is not one of beta, uniform, logit_normal",
        ),
        ({"type": "SampleFlowNoise", "alpha": 0.0}, "alpha, beta and std must be positive"),
    ],
)
def test_parameters_that_make_no_sense_are_refused(cfg, message):
    with pytest.raises(ConfigError, match=message):
        build_transform_from_cfg(cfg)
