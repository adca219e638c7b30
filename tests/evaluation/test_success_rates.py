"""Wilson's interval, McNemar's test on pairs, and what cannot be compared."""

from __future__ import annotations

from math import sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fluxvla_core.errors import UsageError
from fluxvla_core.evaluation.results_file import all_of
from fluxvla_core.evaluation.success_rates import (
    Comparison,
    mcnemar_test,
    one_sided_p,
    smallest_difference,
    verdict,
    wilson_interval,
)


def records(outcomes, task="a", group="policy"):
    return [
        {"group": group, "task": task, "seed": s, "status": "done", "success": bool(x)}
        for s, x in enumerate(outcomes)
    ]


@pytest.mark.parametrize(
    ("for_it", "against", "p"),
    [(0, 0, 1.0), (5, 0, 1 / 32), (0, 5, 1.0), (3, 1, 5 / 16), (8, 2, 56 / 1024), (1, 1, 0.75)],
)
def test_the_one_sided_p_value_is_a_binomial_tail(for_it, against, p):
    assert one_sided_p(for_it, against) == pytest.approx(p)


@pytest.mark.parametrize(
    ("tasks", "name"), [(1, "the task"), (2, "all 2 tasks"), (10, "all 10 tasks")]
)
def test_all_tasks_are_said_of_several_only(tasks, name):
    assert all_of(tasks) == name


def test_counts_below_zero_are_refused():
    with pytest.raises(ValueError, match="counts cannot be below 0: -1, 2"):
        one_sided_p(-1, 2)


def test_the_two_sided_p_value_does_not_depend_on_the_order():
    assert Comparison(0, 0, 8, 2).p_different == pytest.approx(2 * 56 / 1024)
    assert Comparison(0, 0, 2, 8).p_different == Comparison(0, 0, 8, 2).p_different
    assert Comparison(5, 5, 1, 1).p_different == 1.0, "never above 1"


def test_only_pairs_with_one_winner_count():
    few = mcnemar_test(records([1, 1, 1, 0]), records([0, 1, 1, 0]))
    many = mcnemar_test(records([1] + [1, 0] * 50), records([0] + [1, 0] * 50))
    assert (few.both, few.neither, few.only_a, few.only_b, few.pairs) == (2, 1, 1, 0, 4)
    assert many.p_a_better == few.p_a_better == 0.5


def test_episodes_are_paired_by_task_and_seed_whatever_their_order():
    a = records([1, 0]) + records([1, 1], task="b")
    b = list(reversed(records([0, 1]) + records([1, 0], task="b")))
    found = mcnemar_test(a, b)
    assert (found.only_a, found.only_b, found.both) == (2, 1, 1)


def test_errors_and_lone_episodes_are_counted_beside():
    b = records([1, 1, 1])
    b[0] |= {"status": "error"}
    found = mcnemar_test(records([1, 1]), b)
    assert (found.pairs, found.unpaired) == (1, 2)
    assert found.to_dict()["unpaired"] == 2


def test_evaluations_without_a_common_episode_are_refused():
    with pytest.raises(UsageError, match="no finished episode in common") as caught:
        mcnemar_test(records([1]), records([1], task="b"))
    assert "same tasks, seed and number of episodes" in str(caught.value)


def test_two_groups_on_one_side_are_refused():
    mixed = records([1]) + records([0], group="untrained")
    with pytest.raises(UsageError, match="episode a/0 is there twice; compare one group"):
        mcnemar_test(mixed, records([1]))


@pytest.mark.parametrize(("pairs", "least"), [(5, None), (6, 0.9635), (50, 0.1535), (500, 0.0158)])
def test_the_smallest_difference_is_that_of_the_exact_power(pairs, least):
    """By hand for 6 pairs: all must differ, 0.8 ** (1 / 6); the others by simulation, +-0.003."""
    found = smallest_difference(pairs)
    if least is None:
        assert found is None
        return
    assert found == pytest.approx(least, abs=5e-4)
    rng = np.random.default_rng(0)
    wins = rng.binomial(pairs, found, 20_000)
    shown = np.mean([Comparison(0, 0, n, 0).p_different <= 0.05 for n in wins])
    assert shown == pytest.approx(0.8, abs=0.015)


def test_a_verdict_claims_no_more_than_so_few_pairs_can_show():
    assert verdict(Comparison(0, 0, 6, 0).to_dict()) == "a difference"
    assert verdict(Comparison(0, 0, 1, 0).to_dict()) == (
        "nothing shown: 1 pair cannot show any difference"
    )
    assert "with 50 pairs the smallest that would have been shown 8 times of 10 is 15%" in verdict(
        Comparison(40, 8, 2, 0).to_dict()
    )


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        # Newcombe, Statistics in Medicine 17 (1998), table I, method 3.
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0000, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_agrees_with_published_values(successes, trials, low, high):
    assert wilson_interval(successes, trials) == pytest.approx((low, high), abs=5e-5)


@given(st.integers(1, 2000).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_ends_are_the_rates_that_the_score_test_just_accepts(counts):
    successes, trials = counts
    rate, z = successes / trials, 1.959963984540054
    low, high = wilson_interval(successes, trials)
    assert 0 <= low <= rate <= high <= 1
    for end in (low, high):
        if 0 < end < 1:
            assert abs(rate - end) == pytest.approx(z * sqrt(end * (1 - end) / trials), abs=1e-9)


def test_no_trials_say_nothing():
    assert wilson_interval(0, 0) == (0.0, 1.0)


def test_more_confidence_is_a_wider_interval():
    narrow, wide = wilson_interval(5, 10, 0.8), wilson_interval(5, 10, 0.99)
    assert wide[0] < narrow[0] < narrow[1] < wide[1]


@pytest.mark.parametrize("counts", [(-1, 5), (6, 5)])
def test_impossible_counts_are_refused(counts):
    with pytest.raises(ValueError, match="are not counts"):
        wilson_interval(*counts)


def test_impossible_confidence_is_refused():
    with pytest.raises(ValueError, match="between 0 and 1, got 1"):
        wilson_interval(1, 2, 1)
