"""What real-time chunking tells a policy, and that its motion has no seams."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fluxvla_core.control.chunks import Chunk
from fluxvla_core.control.joiners import LatestOnly, RealTime, soft_mask

RATE = 10.0
HORIZON = 10


def paper_weight(i, d, known):
    """Equation 5 of arXiv 2506.07339, one element at a time; ``known`` is its ``H - s``."""
    if i < d:
        return 1.0
    if i >= known:
        return 0.0
    c = (known - i) / (known - d + 1)
    return c * (math.exp(c) - 1) / (math.e - 1)


@pytest.mark.parametrize(("d", "known"), [(0, 10), (3, 7), (4, 4), (0, 1), (10, 10)])
def test_the_soft_mask_is_the_papers(d, known):
    expected = [paper_weight(i, d, known) for i in range(HORIZON)]

    np.testing.assert_allclose(soft_mask(HORIZON, d, known), expected, atol=1e-15)


def test_other_schedules():
    np.testing.assert_allclose(soft_mask(6, 2, 5, "linear"), [1, 1, 0.75, 0.5, 0.25, 0])
    np.testing.assert_array_equal(soft_mask(6, 2, 5, "ones"), [1, 1, 1, 1, 1, 0])
    np.testing.assert_array_equal(soft_mask(6, 2, 5, "zeros"), [1, 1, 0, 0, 0, 0])


def line(observed, start=0.0, slope=1.0):
    """A chunk on the line ``start + slope * t`` from its observation on."""
    actions = start + slope * (np.arange(HORIZON)[:, None] + 1) / RATE
    return Chunk(actions, RATE, observed, np.array([start]))


def test_nothing_is_under_way_at_first():
    assert RealTime().previous_chunk() is None
    assert LatestOnly().previous_chunk() is None


def test_the_rest_of_the_chunk_is_read_off_at_the_times_of_the_new_one():
    joiner = RealTime()
    joiner.add(line(observed=5.0), now=5.25)

    # Observed 0.33 s later: no multiple of an action.
    found = joiner.previous_chunk().continuation(5.33, HORIZON)

    times = 0.33 + (np.arange(HORIZON) + 1) / RATE
    np.testing.assert_allclose(found.actions[:, 0], np.minimum(times, 1.0))
    assert found.frozen == 3  # 0.25 s need the first three actions
    np.testing.assert_allclose(found.weights, soft_mask(HORIZON, 3, 6))
    assert found.max_guidance_weight == 5.0


def test_the_longest_of_the_last_latencies_is_expected():
    joiner = RealTime(window=3)
    frozen = []
    for number, latency in enumerate([0.35, 0.1, 0.1, 0.1, 0.2]):
        observed = float(number)
        joiner.add(line(observed), now=observed + latency)
        frozen.append(joiner.previous_chunk().continuation(observed + 0.1, HORIZON).frozen)

    # A spike is remembered for three answers, then forgotten.
    assert frozen == [4, 4, 4, 1, 2]


def test_a_chunk_that_is_over_before_the_new_one_begins_binds_nothing():
    joiner = RealTime()
    joiner.add(line(observed=0.0), now=0.1)
    ahead = joiner.previous_chunk()

    assert ahead.continuation(1.0, HORIZON) is None
    assert ahead.continuation(0.85, HORIZON).weights[1:].tolist() == [0.0] * 9


def test_a_latency_beyond_what_is_known_freezes_all_of_it():
    joiner = RealTime()
    joiner.add(line(observed=0.0), now=0.9)

    found = joiner.previous_chunk().continuation(0.5, HORIZON)
    assert found.frozen == 5
    assert found.weights.tolist() == [1.0] * 5 + [0.0] * 5


def test_an_answer_in_no_time_freezes_nothing():
    joiner = RealTime()
    joiner.add(line(observed=2.0), now=2.0)

    assert joiner.previous_chunk().continuation(2.1, HORIZON).frozen == 0


def test_the_old_chunk_is_played_up_to_the_first_action_that_is_not_over():
    joiner = RealTime()
    joiner.add(line(observed=0.0), now=0.1)
    joiner.add(line(observed=0.25, start=5.0), now=0.4)

    assert joiner.target(0.4) == pytest.approx([0.4])
    assert joiner.target(0.449) == pytest.approx([0.449])
    assert joiner.target(0.45) == pytest.approx([5.2])


def test_where_the_old_chunk_has_ended_the_new_one_begins_early():
    joiner = RealTime()
    joiner.add(line(observed=0.0), now=0.1)
    assert joiner.target(1.01) is None
    joiner.add(line(observed=0.95, start=5.0), now=1.01)

    assert joiner.target(1.01) == pytest.approx([5.06])
    assert joiner.target(1.96) is None


def test_an_answer_to_an_older_observation_changes_nothing():
    joiner = RealTime()
    joiner.add(line(observed=1.0), now=1.1)
    joiner.add(line(observed=0.5, start=9.0), now=1.2)

    assert joiner.target(1.5) == pytest.approx([0.5])


def test_chunks_that_are_over_are_forgotten():
    joiner = RealTime()
    for number in range(100):
        joiner.add(line(observed=number * 0.1), now=number * 0.1 + 0.05)

    assert len(joiner._chunks) <= 3


def obedient(continuation, observed, anchor, rng):
    """A policy that keeps to what is frozen, and does something else afterwards."""
    actions = rng.normal(size=(HORIZON, 1))
    actions[: continuation.frozen] = continuation.actions[: continuation.frozen]
    return Chunk(actions, RATE, observed, anchor)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    rounds=st.lists(st.tuples(st.floats(0.05, 0.3), st.floats(0.0, 1.0)), min_size=1, max_size=12),
)
def test_a_policy_that_keeps_to_what_is_frozen_leaves_no_seam(seed, rounds):
    """Latencies vary, up to the longest that was measured: the target is continuous throughout."""
    rng = np.random.default_rng(seed)
    joiner = RealTime(window=100)
    joiner.add(line(observed=0.0), now=0.3)
    now = 0.3
    path = []
    for pause, share in rounds:
        observed = now + pause
        ahead = joiner.previous_chunk()
        found = ahead.continuation(observed, HORIZON)
        arrives = observed + share * 0.3
        if found is None or found.frozen < math.ceil(share * 3 - 1e-6):
            break
        path += [(t, joiner.target(t)) for t in np.arange(now, arrives, 0.004)]
        new = obedient(found, observed, joiner.target(observed), rng)
        joiner.add(new, now=arrives)
        now = arrives
    path += [(t, joiner.target(t)) for t in np.arange(now, now + 0.3, 0.004)]
    known = [(t, p[0]) for t, p in path if p is not None]
    # Actions are normal: 4 ms of the steepest line between two of them is below 0.35.
    steps = [abs(b - a) for (s, a), (t, b) in itertools.pairwise(known) if t - s < 0.005]
    assert steps
    assert max(steps) < 0.35
