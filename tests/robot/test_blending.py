"""Joiners that blend chunks: ACT's temporal ensemble, and the cross-fade."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fluxvla_core.control.chunks import Chunk
from fluxvla_core.control.joiners import STREAMED, Overlap, TemporalEnsemble, make_joiner

RATE = 10.0


def chunk(values, observed=0.0, anchor=None):
    actions = np.asarray(values, dtype=float).reshape(len(values), -1)
    start = actions[0] if anchor is None else np.atleast_1d(np.asarray(anchor, dtype=float))
    return Chunk(actions, RATE, observed, start)


def at(joiner, time):
    target = joiner.target(time)
    return None if target is None else float(target[0])


def act_ensemble(chunks, step, m):
    """ACT: chunk ``k`` was asked for at step ``k``, and ``i`` counts from the oldest."""
    said = [c[step - k - 1] for k, c in enumerate(chunks) if 0 <= step - k - 1 < len(c)]
    weights = np.exp(-m * np.arange(len(said)))
    return np.dot(weights / weights.sum(), said)


@pytest.mark.parametrize("m", [0.01, 0.5, -0.3])
def test_asked_once_an_action_it_is_acts_ensemble(m):
    rng = np.random.default_rng(0)
    values = rng.normal(size=(8, 5))
    joiner = TemporalEnsemble(coefficient=m)
    for k, row in enumerate(values):
        joiner.add(chunk(row, observed=k / RATE), now=k / RATE)
        assert at(joiner, (k + 1) / RATE) == pytest.approx(act_ensemble(values[: k + 1], k + 1, m))
    assert at(joiner, 12 / RATE) == pytest.approx(values[7][4])
    assert at(joiner, 12.1 / RATE) is None


def test_a_chunk_that_comes_late_weighs_by_the_time_of_its_observation():
    late, prompt = TemporalEnsemble(coefficient=0.5), TemporalEnsemble(coefficient=0.5)
    first, second = chunk([0.0] * 9, observed=0.0), chunk([1.0] * 9, observed=0.3)
    prompt.add(first, 0.0)
    prompt.add(second, 0.3)
    late.add(second, 0.31)
    late.add(first, 0.4)

    assert at(prompt, 0.5) == at(late, 0.5) == pytest.approx(np.exp(-1.5) / (1 + np.exp(-1.5)))


def test_an_ensemble_keeps_only_what_is_not_over():
    joiner = TemporalEnsemble()
    for k in range(1000):
        joiner.add(chunk([0.0] * 5, observed=k / RATE), now=k / RATE)

    assert len(joiner._chunks) <= 6


def test_large_coefficients_do_not_overflow():
    for m in (1e3, -1e3):
        joiner = TemporalEnsemble(coefficient=m)
        for k in range(4):
            joiner.add(chunk([float(k)] * 50, observed=k / RATE), now=k / RATE)
        assert at(joiner, 0.5) == (0.0 if m > 0 else 3.0)


def test_a_fade_begins_at_the_old_motion_and_ends_on_the_new_one():
    joiner = Overlap(fade_s=0.2)
    joiner.add(chunk([0.0] * 20, observed=0.0), now=0.0)
    joiner.add(chunk([1.0] * 20, observed=0.5), now=0.6)

    assert at(joiner, 0.6) == 0.0
    assert at(joiner, 0.7) == pytest.approx(0.5)
    assert at(joiner, 0.8) == 1.0
    # Slow at both ends: no jump of the speed either.
    assert at(joiner, 0.602) < 1e-3
    assert at(joiner, 0.798) > 1 - 1e-3


def test_a_chunk_that_comes_during_a_fade_is_faded_to_from_there():
    joiner = Overlap(fade_s=0.2)
    joiner.add(chunk([0.0] * 20, observed=0.0), now=0.0)
    joiner.add(chunk([1.0] * 20, observed=0.5), now=0.5)
    joiner.add(chunk([-1.0] * 20, observed=0.6), now=0.6)

    assert at(joiner, 0.6) == pytest.approx(0.5)
    assert at(joiner, 0.8) == -1.0


def test_a_fade_from_a_chunk_that_ended_comes_from_its_end():
    joiner = Overlap(fade_s=0.2)
    joiner.add(chunk([2.0, 3.0], observed=0.0), now=0.0)
    assert at(joiner, 0.3) is None
    joiner.add(chunk([5.0] * 9, observed=0.3), now=0.4)

    assert at(joiner, 0.4) == 3.0
    assert at(joiner, 0.6) == 5.0


def test_an_answer_to_an_older_observation_changes_nothing():
    joiner = Overlap()
    joiner.add(chunk([1.0] * 20, observed=0.5), now=0.5)
    joiner.add(chunk([9.0] * 20, observed=0.4), now=0.6)

    assert at(joiner, 1.0) == 1.0


def test_a_fade_forgets_what_is_hidden():
    joiner = Overlap(fade_s=0.2)
    for k in range(1000):
        joiner.add(chunk([float(k)] * 20, observed=k / RATE), now=k / RATE)

    assert len(joiner._fades) <= 4


@pytest.mark.parametrize("method", STREAMED)
def test_a_new_episode_knows_nothing_of_the_last(method):
    joiner = make_joiner(method)
    joiner.add(chunk([1.0] * 20), now=0.0)
    joiner.reset()

    assert joiner.target(0.1) is None
    assert joiner.wants_chunk(0.0)


@pytest.mark.parametrize("method", STREAMED)
def test_observations_are_spaced_as_asked_for(method):
    joiner = make_joiner(method, every_s=0.5)
    joiner.add(chunk([1.0] * 20, observed=1.0), now=1.2)

    assert not joiner.wants_chunk(1.49)
    assert joiner.wants_chunk(1.5)


arrivals = st.lists(
    st.tuples(
        st.floats(0.0, 0.25),  # from one observation to the next
        st.floats(0.0, 0.3),  # latency
        st.lists(st.floats(-1.0, 1.0), min_size=8, max_size=8),
    ),
    min_size=1,
    max_size=8,
)


def played(joiner, events, constant=None):
    """``(time, target)`` at 50 Hz while chunks arrive; later observations may arrive earlier."""
    observed, due = 0.0, []
    for gap, latency, values in events:
        observed += gap
        shown = values if constant is None else [constant] * len(values)
        due.append((observed + latency, chunk(shown, observed)))
    due.sort(key=lambda item: item[0])
    found = []
    for tick in range(100):
        now = tick * 0.04
        while due and due[0][0] <= now:
            joiner.add(due.pop(0)[1], now)
        target = joiner.target(now)
        if target is not None:
            found.append((now, float(target[0])))
    return found


@pytest.mark.parametrize("method", STREAMED)
@settings(max_examples=40, deadline=None)
@given(events=arrivals, constant=st.floats(-1.0, 1.0))
def test_chunks_that_agree_make_a_motion_that_stands_still(method, events, constant):
    values = [value for _, value in played(make_joiner(method), events, constant)]

    assert values
    np.testing.assert_allclose(values, constant, atol=1e-12)


@pytest.mark.parametrize("method", STREAMED)
@settings(max_examples=40, deadline=None)
@given(events=arrivals)
def test_what_is_joined_stays_between_what_was_said(method, events):
    low = min(min(values) for _, _, values in events)
    high = max(max(values) for _, _, values in events)

    for _, value in played(make_joiner(method), events):
        assert low - 1e-9 <= value <= high + 1e-9


@settings(max_examples=40, deadline=None)
@given(events=arrivals, fade=st.floats(0.1, 0.5))
def test_a_cross_fade_never_jumps(events, fade):
    """No faster than the chunks themselves, plus the way between two of them in one fade."""
    joiner = Overlap(fade_s=fade)
    fastest = (
        max(float(np.abs(np.diff(values)).max()) * RATE for _, _, values in events)
        + len(events) * 1.5 * 2.0 / fade
    )
    path = played(joiner, events)
    for (t0, a), (t1, b) in itertools.pairwise(path):
        if t1 - t0 < 0.041:
            assert abs(b - a) <= fastest * 0.04 + 1e-9
