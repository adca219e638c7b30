"""Paired comparison: hand-computed tails, pairing by task and seed, what cannot be compared."""

from __future__ import annotations

import pytest

from fluxvla_core.errors import UsageError
from fluxvla_core.evaluate.mcnemar import Comparison, compare, describe, one_sided_p


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


def test_counts_below_zero_are_refused():
    with pytest.raises(ValueError, match="counts cannot be below 0: -1, 2"):
        one_sided_p(-1, 2)


def test_the_two_sided_p_value_does_not_depend_on_the_order():
    assert Comparison(0, 0, 8, 2).p_different == pytest.approx(2 * 56 / 1024)
    assert Comparison(0, 0, 2, 8).p_different == Comparison(0, 0, 8, 2).p_different
    assert Comparison(5, 5, 1, 1).p_different == 1.0, "never above 1"


def test_only_pairs_with_one_winner_count():
    few = compare(records([1, 1, 1, 0]), records([0, 1, 1, 0]))
    many = compare(records([1] + [1, 0] * 50), records([0] + [1, 0] * 50))
    assert (few.both, few.neither, few.only_a, few.only_b, few.pairs) == (2, 1, 1, 0, 4)
    assert many.p_a_better == few.p_a_better == 0.5


def test_episodes_are_paired_by_task_and_seed_whatever_their_order():
    a = records([1, 0]) + records([1, 1], task="b")
    b = list(reversed(records([0, 1]) + records([1, 0], task="b")))
    found = compare(a, b)
    assert (found.only_a, found.only_b, found.both) == (2, 1, 1)


def test_errors_and_lone_episodes_are_counted_beside():
    b = records([1, 1, 1])
    b[0] |= {"status": "error"}
    found = compare(records([1, 1]), b)
    assert (found.pairs, found.unpaired) == (1, 2)
    assert found.to_dict()["unpaired"] == 2


def test_evaluations_without_a_common_episode_are_refused():
    with pytest.raises(UsageError, match="no finished episode in common") as caught:
        compare(records([1]), records([1], task="b"))
    assert "same tasks, seed and number of episodes" in str(caught.value)


def test_two_groups_on_one_side_are_refused():
    mixed = records([1]) + records([0], group="untrained")
    with pytest.raises(UsageError, match="episode a/0 is there twice; compare one group"):
        compare(mixed, records([1]))


def test_one_line_says_who_won_what():
    line = describe(Comparison(3, 1, 5, 0), "new", "old")
    assert line == (
        "new against old, 9 pairs: 5 won by new alone, 0 by old alone; "
        "p = 0.062 that they are equal, 0.031 that new is no better"
    )
