"""What was done after which words: whether a policy listens."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from fluxvla_core.evaluate import mcnemar
from fluxvla_core.evaluate.ledger import DONE
from fluxvla_core.evaluate.worker import POLICY, SWAPPED

Records = Sequence[Mapping[str, Any]]


def count_behaviours(records: Records) -> dict[str, Any]:
    """Which tasks were done after which instruction.

    Returns:
        ``{group: {instruction: {"episodes": n, "neither": n, task: n, …}}}``, with the tasks that
        were done at least once anywhere; empty where environments tell of one task alone.
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


def instruction_test(records: Records) -> dict[str, Any] | None:
    """Whether the policy does a scene's task more often when it is told to than when it is told
    another: exact McNemar over the same seeds. None without wrong instructions on them."""
    right, wrong = (
        [r for r in records if r["group"] == group and r["status"] == DONE]
        for group in (POLICY, SWAPPED)
    )
    pairs = {(r["task"], r["seed"]) for r in right} & {(r["task"], r["seed"]) for r in wrong}
    return mcnemar.compare(right, wrong).to_dict() if pairs else None
