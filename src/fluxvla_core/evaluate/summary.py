"""From records of episodes to success rates."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

from fluxvla_core.evaluate.ledger import DONE
from fluxvla_core.evaluate.wilson import wilson_interval

CONFIDENCE = 0.95


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


def summarise(records: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Success by group and task.

    Returns:
        ``{group: {"tasks": {task: rate}, "all": rate}}``, each ``rate`` as :func:`rate` gives it
        with ``errors`` added. An episode that ended in an error is no trial: it says nothing
        about the policy, and is counted beside it.
    """
    table: dict[str, dict[str, list[Mapping[str, Any]]]] = {}
    for record in records:
        table.setdefault(record["group"], {}).setdefault(record["task"], []).append(record)
    return {
        group: {
            "tasks": {task: _counted(found) for task, found in tasks.items()},
            "all": _counted([record for found in tasks.values() for record in found]),
        }
        for group, tasks in table.items()
    }


def problems(records: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """What went wrong in episodes, the most frequent first, as JSON values.

    Returns:
        ``group``, ``what``, ``episodes`` (in how many of them), and ``status``: ``error`` for
        episodes that gave no result, ``done`` for failures of the policy that say why.
    """
    found = Counter(
        (record["group"], record["status"], reason(why))
        for record in records
        if not record.get("success")
        and (why := record.get("problem" if record["status"] == DONE else "error"))
    )
    return [
        {"group": group, "status": status, "what": what, "episodes": count}
        for (group, status, what), count in found.most_common()
    ]


def describe_problem(row: Mapping[str, Any]) -> str:
    """One line for people about a row of :func:`problems`."""
    count = row["episodes"]
    many = "1 episode" if count == 1 else f"{count} episodes"
    failed = "failed" if row["status"] == DONE else "gave no result"
    return f"{row['group']}: {many} {failed}: {row['what']}"


def reason(text: str) -> str:
    """What a message or a traceback says in one line: the last that is no advice."""
    lines = text.strip().splitlines()
    said = [line for line in lines if not line.startswith(("  likely cause: ", "  next: "))]
    return (said or lines)[-1].strip()


def describe(name: str, counted: Mapping[str, Any]) -> str:
    """One line for people: ``lift_hold: 44/50 = 88 % (95 % interval 76 to 94 %)``."""
    if not counted["episodes"]:
        return f"{name}: no episode gave a result ({counted['errors']} errors)"
    errors = f", {counted['errors']} errors" if counted.get("errors") else ""
    share = f"{counted['successes']}/{counted['episodes']} = {counted['rate']:.0%}"
    ends = f"{counted['low']:.0%} to {counted['high']:.0%}"
    return f"{name}: {share} ({counted['confidence']:.0%} interval {ends}){errors}"


def _counted(records: list[Mapping[str, Any]]) -> dict[str, Any]:
    done = [record for record in records if record["status"] == DONE]
    successes = sum(bool(record["success"]) for record in done)
    return {**rate(successes, len(done)), "errors": len(records) - len(done)}
