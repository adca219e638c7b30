"""Actions to commands: where each command lies, how many there are, what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from fluxvla_core.control.chunks import interpolate, sample


def test_five_commands_lead_to_each_action():
    commands = interpolate([0.0, 10.0], [[1.0, 10.0], [1.0, 5.0]], 10, 50)

    assert commands.shape == (10, 2)
    np.testing.assert_allclose(commands[:5, 0], [0.2, 0.4, 0.6, 0.8, 1.0])
    np.testing.assert_allclose(commands[:5, 1], 10.0)
    np.testing.assert_allclose(commands[5:, 0], 1.0)
    np.testing.assert_allclose(commands[5:, 1], [9, 8, 7, 6, 5])


def test_equal_rates_give_the_chunk_itself():
    chunk = np.random.default_rng(0).normal(size=(7, 3))

    np.testing.assert_array_equal(interpolate(np.zeros(3), chunk, 50, 50), chunk)


@pytest.mark.parametrize(
    ("count", "rate", "control", "expected"),
    [(3, 10, 50, 15), (20, 10, 50, 100), (1, 3, 100, 33), (2, 50, 10, 1), (4, 30, 30, 4)],
)
def test_as_many_commands_as_fit_before_the_last_action(count, rate, control, expected):
    commands = interpolate([0.0], np.ones((count, 1)), rate, control)

    assert len(commands) == expected


def test_rates_without_a_whole_ratio_stay_on_the_lines():
    commands = interpolate([0.0], [[1.0], [2.0], [3.0]], 10, 33)

    np.testing.assert_allclose(commands[:, 0], (np.arange(len(commands)) + 1) / 33 * 10)
    assert len(commands) == 9


def test_an_empty_chunk_gives_no_commands():
    assert interpolate([0.0], np.empty((0, 1)), 10, 50).shape == (0, 1)


def test_sampling_holds_before_the_start_and_after_the_end():
    points = sample([0.0], [[1.0], [3.0]], 10, [-1.0, 0.0, 0.15, 0.2, 9.0])

    np.testing.assert_allclose(points[:, 0], [0.0, 0.0, 2.0, 3.0, 3.0])


@pytest.mark.parametrize("rates", [(0, 50), (10, -1)])
def test_rates_must_be_positive(rates):
    with pytest.raises(ValueError, match="rates must be positive"):
        interpolate([0.0], [[1.0]], *rates)


def test_shapes_that_do_not_fit_are_named():
    with pytest.raises(ValueError, match=r"got \(2,\) and \(4, 3\)"):
        interpolate([0.0, 0.0], np.ones((4, 3)), 10, 50)
    with pytest.raises(ValueError, match=r"shape \(T, D\), got \(3,\)"):
        interpolate([0.0], np.ones(3), 10, 50)
