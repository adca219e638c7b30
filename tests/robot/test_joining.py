"""How chunks become one motion."""

from __future__ import annotations

import numpy as np
import pytest

from fluxvla_core.control.chunks import Chunk, sample
from fluxvla_core.control.joiners import LatestOnly, Synchronous


def chunk(values, observed=0.0, anchor=0.0, rate=10.0):
    return Chunk(np.array(values, dtype=float)[:, None], rate, observed, np.array([anchor]))


def at(joiner, time):
    target = joiner.target(time)
    return None if target is None else float(target[0])


def test_a_synchronous_chunk_starts_when_it_arrives():
    joiner = Synchronous()
    joiner.add(chunk([1.0, 2.0], observed=0.0), now=5.0)

    assert at(joiner, 5.05) == pytest.approx(0.5)
    assert at(joiner, 5.2) == pytest.approx(2.0)
    assert at(joiner, 5.21) is None


def test_a_synchronous_chunk_is_played_before_the_next_is_wanted():
    joiner = Synchronous()
    assert joiner.wants_chunk(0.0)

    joiner.add(chunk([1.0, 2.0]), now=1.0)

    assert not joiner.wants_chunk(1.19)
    assert joiner.wants_chunk(1.2)
    joiner.reset()
    assert joiner.wants_chunk(1.0)
    assert joiner.target(1.0) is None


def test_summed_steps_of_a_simulated_clock_do_not_lose_the_last_command():
    joiner = Synchronous()
    now = 0.0
    for _ in range(1000):
        now += 0.02
    joiner.add(chunk([1.0, 2.0]), now=now)
    rows = 0
    while joiner.target(now + (rows + 1) * 0.02) is not None:
        rows += 1

    assert rows == 10


def test_the_latest_chunk_plays_on_the_time_of_its_observation():
    joiner = LatestOnly()
    assert joiner.target(0.0) is None

    joiner.add(chunk([1.0, 2.0, 3.0], observed=10.0), now=10.15)

    assert at(joiner, 10.15) == pytest.approx(1.5)
    assert at(joiner, 10.3) == pytest.approx(3.0)
    assert at(joiner, 10.4) is None
    assert joiner.wants_chunk(10.15)


def test_a_newer_chunk_replaces_and_an_older_one_does_not():
    joiner = LatestOnly()
    joiner.add(chunk([1.0] * 9, observed=1.0, anchor=1.0), now=1.1)
    joiner.add(chunk([2.0] * 9, observed=2.0, anchor=2.0), now=2.1)
    joiner.add(chunk([9.0] * 9, observed=1.5, anchor=9.0), now=2.2)

    assert at(joiner, 2.3) == 2.0
    joiner.reset()
    assert joiner.target(2.3) is None


def test_a_moment_of_a_chunk_is_that_of_its_samples_bit_for_bit():
    random = np.random.default_rng(3)
    for count in (1, 2, 7):
        one = Chunk(random.normal(size=(count, 4)), 10.0, 5.0, random.normal(size=4))
        moments = np.concatenate(
            [random.uniform(-0.2, count / 10 + 0.2, 40), np.arange(count + 1) / 10]
        )
        for elapsed in moments:
            expected = sample(one.anchor, one.actions, one.rate_hz, [elapsed])[0]
            np.testing.assert_array_equal(one.at(elapsed), expected)
