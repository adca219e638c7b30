"""Which episodes to show people: failures teach more than successes, so they come first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from fluxvla_core.evaluate.ledger import DONE


def choose_episodes(
    records: Sequence[Mapping[str, Any]], count: int, group: str = "policy"
) -> list[Mapping[str, Any]]:
    """Up to ``count`` records of ``group``: half failures, half successes, tasks in turn.

    Where there are not enough of one kind the other fills up. Failures come first.
    """
    mine = [r for r in records if r["group"] == group and r["status"] == DONE]
    failures = _in_turn([r for r in mine if not r["success"]])
    successes = _in_turn([r for r in mine if r["success"]])
    shown = min(len(failures), max((count + 1) // 2, count - len(successes)))
    return failures[:shown] + successes[: count - shown]


def video_name(number: int, record: Mapping[str, Any]) -> str:
    """``00-failure-TASK-seed-SEED.mp4``."""
    word = "success" if record["success"] else "failure"
    return f"{number:02d}-{word}-{record['task']}-seed-{record['seed']}.mp4"


def _in_turn(records: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    seen: dict[str, int] = {}
    ranked = []
    for record in records:
        rank = seen.get(record["task"], 0)
        seen[record["task"]] = rank + 1
        ranked.append((rank, record))
    return [record for _, record in sorted(ranked, key=lambda pair: pair[0])]
