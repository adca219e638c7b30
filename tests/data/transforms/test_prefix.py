"""How long prefixes are drawn."""

from __future__ import annotations

import numpy as np
import pytest

from fluxvla_core.build import build_transform_from_cfg
from fluxvla_core.data.transforms.noise import SamplePrefixLength
from fluxvla_core.errors import ConfigError


def lengths(distribution, draws=20000):
    table = {"type": "SamplePrefixLength", "max_delay": 3, "distribution": distribution}
    sample = {"actions": np.zeros((5, 2)), "time": np.zeros(draws)}
    found = build_transform_from_cfg(table)(sample, np.random.default_rng(0))["prefix_len"]
    assert found.shape == (draws,)
    assert found.dtype == np.int64
    return np.bincount(found, minlength=5) / draws


def test_uniform():
    np.testing.assert_allclose(lengths("uniform"), [0.25] * 4 + [0.0], atol=0.02)


def test_exponential():
    shares = np.exp(-np.arange(4.0))
    np.testing.assert_allclose(lengths("exponential"), [*(shares / shares.sum()), 0.0], atol=0.02)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"max_delay": 0}, "max_delay must be at least 1, got 0"),
        ({"max_delay": 2, "distribution": "normal"}, "'normal' is not one of uniform, exponential"),
    ],
)
def test_settings_that_mean_nothing(settings, words):
    with pytest.raises(ConfigError, match=words):
        SamplePrefixLength(**settings)


def test_samples_that_it_does_not_fit():
    rng = np.random.default_rng(0)
    with pytest.raises(ConfigError, match="the sample has no 'time'") as caught:
        SamplePrefixLength(2)({"actions": np.zeros((5, 2))}, rng)
    assert "behind SampleFlowNoise" in str(caught.value)
    with pytest.raises(ConfigError, match="max_delay 5 leaves nothing to predict of chunks of 5"):
        SamplePrefixLength(5)({"actions": np.zeros((5, 2)), "time": np.zeros(1)}, rng)
