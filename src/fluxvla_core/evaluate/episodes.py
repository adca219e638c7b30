"""Run episodes in worker processes and keep their results as they come.

What an episode needs (a simulator, a policy) is made by a factory in each worker process. Its
result must follow from the episode's key alone; then neither the number of workers nor an
interruption changes anything but the time it takes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from fluxvla_core.contracts.reporter import Reporter
from fluxvla_core.evaluate.ledger import DONE, ERROR, EpisodeKey, Ledger
from fluxvla_core.evaluate.pool import Outcome, WorkerPool
from fluxvla_core.evaluate.summary import reason

EpisodeFactory = Callable[[], Callable[[EpisodeKey], dict[str, Any]]]


def run_episodes(
    factory: EpisodeFactory,
    keys: Sequence[EpisodeKey],
    ledger: Ledger,
    workers: int,
    reporter: Reporter,
    timeout_s: float | None = None,
) -> list[dict[str, Any]]:
    """:func:`run_in_pool` with processes of its own.

    Args:
        factory: makes, in a worker process, the function from a key to a result.
        workers: processes.
        timeout_s: how long one attempt at an episode may take.
    """
    with WorkerPool(factory, workers, timeout_s=timeout_s) as pool:
        return run_in_pool(pool, keys, ledger, reporter)


def run_in_pool(
    pool: WorkerPool, keys: Sequence[EpisodeKey], ledger: Ledger, reporter: Reporter
) -> list[dict[str, Any]]:
    """Run the episodes of ``keys`` that ``ledger`` does not have yet.

    Args:
        pool: its factory makes, in a worker process, a function from a key to a result: JSON
            values with at least ``success`` (bool) and ``steps`` (int).

    Returns:
        One record for each key, in their order: the result with ``group``, ``task``, ``seed``,
        ``attempts``, and ``status``, which is ``done``, or ``error`` with the reason in ``error``.

    Raises:
        RunFailed: workers cannot be started, or results cannot be kept.
        FluxError: one that means bad input, from a worker.
        KeyboardInterrupt: after the workers have been ended; finished episodes are kept.
    """
    missing = [key for key in keys if key not in ledger]
    errors: dict[EpisodeKey, dict[str, Any]] = {}
    done, began = len(keys) - len(missing), time.monotonic()
    succeeded = sum(bool(record["success"]) for record in ledger.records(keys))
    if done and missing:
        reporter.info(f"{done} of {len(keys)} episodes are there already; going on with the others")
    with closing(pool.run(missing)) as outcomes:
        for outcome in outcomes:
            key = missing[outcome.index]
            record = _record(key, outcome)
            ledger.add(record)
            if record["status"] == ERROR:
                errors[key] = record
                reporter.warn(_error_line(record))
            done += 1
            succeeded += bool(record.get("success"))
            reporter.event("episode", **record)
            pace = 60 * (done - len(keys) + len(missing)) / (time.monotonic() - began)
            reporter.progress(
                "episodes", done, len(keys), successes=succeeded, per_minute=round(pace, 1)
            )
    return [errors[key] if key in errors else ledger.records([key])[0] for key in keys]


def _record(key: EpisodeKey, outcome: Outcome) -> dict[str, Any]:
    head = {"group": key.group, "task": key.task, "seed": key.seed}
    if outcome.error is not None:
        tail: dict[str, Any] = {"status": ERROR, "error": outcome.error}
    else:
        tail = {"status": DONE, **outcome.result}
    return {**head, **tail, "attempts": outcome.attempts}


def _error_line(record: dict[str, Any]) -> str:
    return (
        f"episode {record['group']}/{record['task']}/{record['seed']} gave no result "
        f"after {record['attempts']} attempts: {reason(record['error'])}"
    )


def open_ledger(
    path: Path, what: dict[str, Any], reporter: Reporter, beside: str | None = None
) -> Ledger:
    """The ledger of an evaluation of ``what``; says so if another one was in the way."""
    ledger = Ledger(path, what, beside)
    if ledger.set_aside is not None:
        reporter.info(
            f"{path.name} was about another evaluation; it is {ledger.set_aside.name} now"
        )
    return ledger


def episode_keys(
    groups: Sequence[tuple[str, int]], tasks: Sequence[str], episodes: int, together: bool
) -> list[EpisodeKey]:
    """Every episode of an evaluation, in the order in which they are given out.

    Args:
        groups: name and first seed of each; those of one number are side by side.
        episodes: for each task and group.
        together: task by task; otherwise in turn, so that an evaluation that is watched tells of
            all tasks from the start.
    """
    numbers = range(episodes)
    pairs = [(task, number) for number in numbers for task in tasks]
    if together:
        pairs = [(task, number) for task in tasks for number in numbers]
    return [
        EpisodeKey(group, task, first + number) for task, number in pairs for group, first in groups
    ]
