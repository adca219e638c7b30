"""Run the episodes of an evaluation in worker processes, or this process's shard of them.

What an episode needs (a simulator, a policy) is made by a factory in each worker process. Its
result must follow from the episode's key alone; then neither the number of workers nor an
interruption changes anything but the time it takes.

torchrun sets ``RANK`` and ``WORLD_SIZE``, a SLURM array ``SLURM_ARRAY_TASK_ID`` (with ``_MIN``,
``_COUNT``), ``srun`` ``SLURM_PROCID`` and ``SLURM_NTASKS``; an array of srun steps has both. Nobody
has to wait for anybody: each shard has an episode log of its own in the same folder, and whoever
finds all episodes finished writes the results.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any, TypeVar

from fluxvla_core.contracts.reporter import Reporter
from fluxvla_core.errors import UsageError
from fluxvla_core.evaluation.episode_log import DONE, ERROR, EpisodeKey, EpisodeLog
from fluxvla_core.evaluation.pool import Outcome, WorkerPool
from fluxvla_core.evaluation.statistics import reason


def run_in_pool(
    pool: WorkerPool, keys: Sequence[EpisodeKey], log: EpisodeLog, reporter: Reporter
) -> list[dict[str, Any]]:
    """Run the episodes of ``keys`` that ``log`` does not have yet.

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
    missing = [key for key in keys if key not in log]
    errors: dict[EpisodeKey, dict[str, Any]] = {}
    done, began = len(keys) - len(missing), time.monotonic()
    succeeded = sum(bool(record["success"]) for record in log.records(keys))
    if done and missing:
        reporter.info(f"{done} of {len(keys)} episodes are there already; going on with the others")
    with closing(pool.run(missing)) as outcomes:
        for outcome in outcomes:
            key = missing[outcome.index]
            record = _record(key, outcome)
            log.add(record)
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
    return [errors[key] if key in errors else log.records([key])[0] for key in keys]


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


T = TypeVar("T")


@dataclass(frozen=True)
class Shard:
    """Part ``index`` of ``count`` of an evaluation's episodes; all of them by default."""

    index: int = 0
    count: int = 1

    def of(self, items: Sequence[T]) -> list[T]:
        """Every ``count``-th item: each part has some of every task."""
        return list(items[self.index :: self.count])

    @property
    def log_name(self) -> str:
        """The file name of this part's episode log."""
        if self.count == 1:
            return "episodes.jsonl"
        return f"episodes-{self.index:04d}-of-{self.count:04d}.jsonl"


def shard_of(environment: Mapping[str, str] | None = None) -> Shard:
    """The part that the process's environment variables say it is.

    Raises:
        UsageError: they make no sense.
    """
    env = os.environ if environment is None else environment
    try:
        array = _array(env)
        step = _pair(env, "RANK", "WORLD_SIZE") or _pair(env, "SLURM_PROCID", "SLURM_NTASKS")
    except ValueError as error:
        raise UsageError(f"this process cannot tell which part of the job it is: {error}") from None
    (a, n), (b, m) = array or (0, 1), step or (0, 1)
    if not (0 <= a < n and 0 <= b < m):
        raise UsageError(
            f"this process is said to be part {a} of {n} and {b} of {m}",
            cause="RANK, WORLD_SIZE or SLURM_* were changed by hand",
        )
    return Shard(a * m + b, n * m)


def _array(env: Mapping[str, str]) -> tuple[int, int] | None:
    if "SLURM_ARRAY_TASK_ID" not in env:
        return None
    if int(env.get("SLURM_ARRAY_TASK_STEP", "1")) != 1:
        raise ValueError("the SLURM array counts in steps; use --array=0-N")
    first = int(env.get("SLURM_ARRAY_TASK_MIN", "0"))
    return int(env["SLURM_ARRAY_TASK_ID"]) - first, int(env["SLURM_ARRAY_TASK_COUNT"])


def _pair(env: Mapping[str, str], index: str, count: str) -> tuple[int, int] | None:
    if index not in env or count not in env:
        return None
    return int(env[index]), int(env[count])
