"""Two evaluations of the same episodes, compared pair by pair: McNemar's exact test.

Q. McNemar, "Note on the sampling error of the difference between correlated proportions or
percentages", Psychometrika 12 (1947), 153-157. Only episodes where one side succeeded and the
other did not say anything. If neither is better, each of them is a fair coin, so the p-value is
a binomial tail and holds for small numbers too.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import comb
from typing import Any

from fluxvla_core.errors import UsageError
from fluxvla_core.evaluate.ledger import DONE


@dataclass(frozen=True)
class Comparison:
    """How two sides did on the same episodes.

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
        """One-sided: how often chance alone would favour A this much or more."""
        return one_sided_p(self.only_a, self.only_b)

    @property
    def p_different(self) -> float:
        """Two-sided: how often chance alone would make a difference this large or larger."""
        return min(1.0, 2 * one_sided_p(*sorted((self.only_a, self.only_b), reverse=True)))

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


def compare(a: Iterable[Mapping[str, Any]], b: Iterable[Mapping[str, Any]]) -> Comparison:
    """Pair the records of two evaluations by task and seed.

    Args:
        a, b: records of the ledger, each of one group.

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


def describe(comparison: Comparison, name_a: str, name_b: str) -> str:
    """One line for people."""
    c = comparison
    return (
        f"{name_a} against {name_b}, {c.pairs} pairs: {c.only_a} won by {name_a} alone, "
        f"{c.only_b} by {name_b} alone; p = {c.p_different:.2g} that they are equal, "
        f"{c.p_a_better:.2g} that {name_a} is no better"
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
