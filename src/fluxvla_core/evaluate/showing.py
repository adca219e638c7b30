"""Which episodes to show people: failures teach more than successes, so they come first."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from fluxvla_core.contracts.reporter import Reporter
from fluxvla_core.evaluate.ledger import DONE, EpisodeKey
from fluxvla_core.evaluate.pool import WorkerPool


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


def record_videos(
    pool: WorkerPool,
    records: Sequence[Mapping[str, Any]],
    folder: Path,
    make_job: Callable[[EpisodeKey, str], Any],
    reporter: Reporter,
) -> list[dict[str, Any]]:
    """Run the episodes of ``records`` once more, watched: they go as they went before.

    Args:
        pool: its workers return a result with ``state_hash``, as the records have it.
        folder: where the videos go; those of an evaluation before are removed.
        make_job: from a key and a path to the job that runs it and leaves its video there.

    Returns:
        JSON values, one for each video that was made, in the order of ``records``: ``group``,
        ``task``, ``seed``, ``success`` and ``path``, relative to ``folder``'s parent.
    """
    # Another part of the same job may be doing the same: each makes its own, then puts them there.
    part = folder / f".part-{os.getpid()}"
    part.mkdir(parents=True, exist_ok=True)
    names = [video_name(number, record) for number, record in enumerate(records)]
    jobs = [
        make_job(EpisodeKey(r["group"], r["task"], r["seed"]), str(part / name))
        for r, name in zip(records, names, strict=True)
    ]
    made = [False] * len(jobs)
    with closing(pool.run(jobs)) as outcomes:
        for done, outcome in enumerate(outcomes, 1):
            reporter.progress("videos", done, len(jobs))
            made[outcome.index] = outcome.error is None
            if outcome.error is not None:
                reporter.warn(f"no video {names[outcome.index]}: {outcome.error}")
            elif outcome.result["state_hash"] != records[outcome.index]["state_hash"]:
                reporter.warn(
                    f"{names[outcome.index]}: the episode went another way than when it was "
                    "counted; its outcome does not follow from its seed alone"
                )
    for old in folder.glob("*.mp4"):
        if old.name not in names:
            old.unlink(missing_ok=True)
    for name in names:
        made_here = part / name
        if made_here.exists():
            made_here.replace(folder / name)
    shutil.rmtree(part, ignore_errors=True)
    return [
        {
            **{key: record[key] for key in ("group", "task", "seed", "success")},
            "path": f"{folder.name}/{name}",
        }
        for record, name, there in zip(records, names, made, strict=True)
        if there
    ]


def recorded_videos(
    records: Sequence[Mapping[str, Any]], folder: Path, below: str
) -> list[dict[str, Any]]:
    """The videos that were made while the episodes ran, as :func:`record_videos` lists its own.

    Args:
        records: of live episodes, with ``record``: their folders, relative to ``folder/below``.
    """
    return [
        {
            **{key: record[key] for key in ("group", "task", "seed", "success")},
            "path": video.relative_to(folder).as_posix(),
        }
        for record in records
        for video in sorted((folder / below / record["record"]).glob("*.mp4"))[:1]
    ]


def _in_turn(records: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    seen: dict[str, int] = {}
    ranked = []
    for record in records:
        rank = seen.get(record["task"], 0)
        seen[record["task"]] = rank + 1
        ranked.append((rank, record))
    return [record for _, record in sorted(ranked, key=lambda pair: pair[0])]
