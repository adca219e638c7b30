"""Success rates with confidence intervals, McNemar's test, and what episodes did.

Intervals: E. B. Wilson, "Probable inference, the law of succession, and statistical inference",
JASA 22 (1927), 209-212. Unlike the textbook interval Wilson's stays within 0 and 1 and holds its
level for small counts and for rates near 0 and 1 (Brown, Cai and DasGupta, Statistical Science 16
(2001), 101-133).

Pairs: Q. McNemar, "Note on the sampling error of the difference between correlated proportions or
percentages", Psychometrika 12 (1947), 153-157. Only episodes where one side succeeded and the
other did not say anything. If neither is better, each of them is a fair coin, so the p-value is
a binomial tail and holds for small numbers too.

What so few pairs could have shown is the test's exact power: S. W. Duffy, "Asymptotic and exact
power for the McNemar test and its analogue with R controls per case", Biometrics 40 (1984),
1005-1015. The number of pairs that differ is binomial, and so are the wins among them; the power is
the probability of those counts at which the test rejects.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import comb, sqrt
from statistics import NormalDist
from typing import Any

from fluxvla_core.errors import UsageError
from fluxvla_core.evaluation.episodes import DONE, POLICY, SWAPPED

CONFIDENCE = 0.95
LEVEL = 0.05
"""Significance level of the tests."""
POWER = 0.8
"""How often ``smallest_difference`` would have been shown."""

Records = Sequence[Mapping[str, Any]]


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Lower and upper end of the interval for a success rate.

    With rate ``p``, trials ``n`` and normal quantile ``z`` of ``(1 + confidence) / 2``::

        (p + z^2/2n ± z sqrt(p(1-p)/n + z^2/4n^2)) / (1 + z^2/n)

    No trials say nothing: (0, 1).

    Raises:
        ValueError: counts below 0, more successes than trials, or a confidence outside (0, 1).
    """
    if not 0 <= successes <= trials:
        raise ValueError(f"{successes} successes of {trials} trials are not counts")
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must be between 0 and 1, got {confidence}")
    if trials == 0:
        return 0.0, 1.0
    z = NormalDist().inv_cdf((1 + confidence) / 2)
    rate, spread = successes / trials, z * z / trials
    middle = rate + spread / 2
    half = z * sqrt(rate * (1 - rate) / trials + spread / trials / 4)
    low, high = (middle - half) / (1 + spread), (middle + half) / (1 + spread)
    # Rounding must not leave a rate of exactly 0 or 1 outside its own interval.
    return max(0.0, min(low, rate)), min(1.0, max(high, rate))


def rate(successes: int, episodes: int) -> dict[str, Any]:
    """Counts with their success rate and its 95 % Wilson interval, as JSON values.

    ``rate`` is None when there are no episodes.
    """
    low, high = wilson_interval(successes, episodes, CONFIDENCE)
    return {
        "episodes": episodes,
        "successes": successes,
        "rate": successes / episodes if episodes else None,
        "low": low,
        "high": high,
        "confidence": CONFIDENCE,
    }


def count_behaviours(records: Records) -> dict[str, Any]:
    """Count which tasks were done under which instruction.

    Returns:
        ``{group: {instruction: {"episodes": n, "neither": n, task: n, …}}}``, with the tasks that
        were done at least once anywhere; empty where environments report one task alone.
    """
    done = [r for r in records if r["status"] == DONE and len(r.get("behaviours") or ()) > 1]
    seen = dict.fromkeys(name for r in done for name, did in r["behaviours"].items() if did)
    table: dict[str, Any] = {}
    for record in done:
        row = table.setdefault(record["group"], {}).setdefault(
            record["instruction"], {"episodes": 0, "neither": 0, **dict.fromkeys(seen, 0)}
        )
        row["episodes"] += 1
        row["neither"] += not any(record["behaviours"].values())
        for name, did in record["behaviours"].items():
            if did:
                row[name] += 1
    return table


def obeyed(record: Mapping[str, Any], records: Records) -> bool | None:
    """Whether the task of the episode's instruction was done, whatever the scene's own task is.

    None if it is not known which task that is: the one that has this instruction in the policy's
    own episodes.
    """
    tasks = {r["instruction"]: r["task"] for r in records if r["group"] == POLICY}
    return (record.get("behaviours") or {}).get(tasks.get(record["instruction"]))


def count_obeyed(records: Records) -> dict[str, Any]:
    """``{group: rate}``: how often a group did the task of its instruction."""
    done = [r for r in records if r["status"] == DONE and len(r.get("behaviours") or ()) > 1]
    found: dict[str, list[bool]] = {}
    for record in done:
        did = obeyed(record, done)
        if did is not None:
            found.setdefault(record["group"], []).append(did)
    return {group: rate(sum(all_), len(all_)) for group, all_ in found.items()}


def instruction_test(records: Records) -> dict[str, Any] | None:
    """Whether the policy does a scene's task more often when instructed to than when given
    another: exact McNemar over the same seeds, its ``verdict`` in words. None without wrong
    instructions on them."""
    right, wrong = (
        [r for r in records if r["group"] == group and r["status"] == DONE]
        for group in (POLICY, SWAPPED)
    )
    pairs = {(r["task"], r["seed"]) for r in right} & {(r["task"], r["seed"]) for r in wrong}
    if not pairs:
        return None
    tested = mcnemar_test(right, wrong).to_dict()
    return {**tested, "verdict": verdict(tested)}


@dataclass(frozen=True)
class Comparison:
    """Comparison of two sides on the same episodes.

    Args:
        both, neither: pairs in which both sides succeeded, or neither did.
        only_a, only_b: pairs in which one side alone did.
        unpaired: episodes that only one side has, or that ended in an error on one side.
    """

    both: int
    neither: int
    only_a: int
    only_b: int
    unpaired: int = 0

    @property
    def pairs(self) -> int:
        return self.both + self.neither + self.only_a + self.only_b

    @property
    def p_a_better(self) -> float:
        """One-sided: how often two equal sides would come out this much in favour of A, or more."""
        return one_sided_p(self.only_a, self.only_b)

    @property
    def p_different(self) -> float:
        """Two-sided: how often two equal sides would come out this different, or more."""
        return min(1.0, 2 * one_sided_p(*sorted((self.only_a, self.only_b), reverse=True)))

    @property
    def smallest_difference(self) -> float | None:
        """See :func:`smallest_difference`, of as many pairs."""
        return smallest_difference(self.pairs)

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {
            "pairs": self.pairs,
            "both": self.both,
            "neither": self.neither,
            "only_a": self.only_a,
            "only_b": self.only_b,
            "unpaired": self.unpaired,
            "p_a_better": self.p_a_better,
            "p_different": self.p_different,
            "smallest_difference": self.smallest_difference,
        }


def one_sided_p(for_it: int, against: int) -> float:
    """Probability of at least ``for_it`` heads in ``for_it + against`` tosses of a fair coin.

    1 when there are no tosses.

    Raises:
        ValueError: a count is below 0.
    """
    if for_it < 0 or against < 0:
        raise ValueError(f"counts cannot be below 0: {for_it}, {against}")
    tosses = for_it + against
    tail = sum(comb(tosses, heads) for heads in range(for_it, tosses + 1))
    return float(tail / 2**tosses)


def smallest_difference(pairs: int) -> float | None:
    """The smallest difference of two success rates that so many pairs could have shown.

    At best: where all pairs that differ favour one side. The two-sided test then rejects from ``k``
    of them on, ``k`` the least with ``2 / 2**k <= LEVEL``; the power is the binomial probability of
    ``k`` or more among ``pairs``, each with the difference as its probability, and is ``POWER``.

    Returns:
        In 0..1; None where even a difference of 1 could not be shown.
    """
    least = next(k for k in range(1, 64) if 2 * one_sided_p(k, 0) <= LEVEL)
    if pairs < least:
        return None

    def shown(difference: float) -> float:
        missed = sum(
            comb(pairs, k) * difference**k * (1 - difference) ** (pairs - k) for k in range(least)
        )
        return 1 - missed

    low, high = 0.0, 1.0
    while high - low > 1e-6:
        middle = (low + high) / 2
        low, high = (low, middle) if shown(middle) >= POWER else (middle, high)
    return high


def verdict(comparison: Mapping[str, Any]) -> str:
    """A test's result, as :meth:`Comparison.to_dict` gives it, in words."""
    if comparison["p_different"] <= LEVEL:
        return "a difference"
    least, pairs = comparison["smallest_difference"], comparison["pairs"]
    many = "1 pair" if pairs == 1 else f"{pairs} pairs"
    if least is None:
        return f"nothing shown: {many} cannot show any difference"
    return (
        f"no difference shown, which is not that there is none: with {many} the smallest that "
        f"would have been shown 8 times of 10 is {least:.0%}, if all that differ favour one side"
    )


def mcnemar_test(a: Iterable[Mapping[str, Any]], b: Iterable[Mapping[str, Any]]) -> Comparison:
    """McNemar's exact test on two evaluations, their records paired by task and seed.

    Args:
        a, b: records of an evaluation log, each of one group.

    Raises:
        UsageError: no episode is on both sides, or a side has one twice.
    """
    left, right = _by_episode(a), _by_episode(b)
    common = left.keys() & right.keys()
    if not common:
        raise UsageError(
            f"the two evaluations have no finished episode in common "
            f"({len(left)} and {len(right)} episodes)",
            cause="they were run on other tasks or seeds",
            next="evaluate both with the same tasks, seed and number of episodes",
        )
    pairs = [(left[key], right[key]) for key in common]
    return Comparison(
        both=sum(x and y for x, y in pairs),
        neither=sum(not x and not y for x, y in pairs),
        only_a=sum(x and not y for x, y in pairs),
        only_b=sum(y and not x for x, y in pairs),
        unpaired=len(left.keys() ^ right.keys()),
    )


def _by_episode(records: Iterable[Mapping[str, Any]]) -> dict[tuple[str, int], bool]:
    found: dict[tuple[str, int], bool] = {}
    for record in records:
        if record["status"] != DONE:
            continue
        key = record["task"], record["seed"]
        if key in found:
            raise UsageError(
                f"episode {key[0]}/{key[1]} is there twice; compare one group with one group"
            )
        found[key] = bool(record["success"])
    return found
