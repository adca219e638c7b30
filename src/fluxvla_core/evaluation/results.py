"""``results.json`` of an evaluation, its videos, and what it says at its end."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from fluxvla_core import atomic
from fluxvla_core.build import RunContext
from fluxvla_core.config.load import CONFIG_FILE
from fluxvla_core.config.load import FORMAT as CONFIG_FORMAT
from fluxvla_core.config.snapshot import write_json
from fluxvla_core.contracts.reporter import Reporter
from fluxvla_core.errors import RunFailed
from fluxvla_core.evaluation.episodes import DONE, EpisodeKey, reason
from fluxvla_core.evaluation.pool import WorkerPool
from fluxvla_core.evaluation.statistics import all_of, describe_problem, describe_rate

FORMAT = "fluxvla-eval-1"
NAMED = 5
"""How many different problems are reported; all are in the results."""


def save_results(folder: Path, results: Mapping[str, Any], context: RunContext) -> None:
    """Write ``results.json`` and the config that ran into ``folder``, and report the rates.

    Raises:
        RunFailed: the disk is full, or the folder was taken away.
    """
    write_results(folder / "results.json", results)
    keep_config(folder, context)
    context.reporter.artifact("evaluation", folder / "results.json")
    report_results(context.reporter, results, folder)


def write_results(path: Path, results: Mapping[str, Any]) -> None:
    """Write ``results`` as JSON, atomically.

    Raises:
        RunFailed: the disk is full, or the folder was taken away.
    """
    try:
        atomic.write_text(path, atomic.json_text(results, indent=1) + "\n")
    except OSError as error:
        full = error.errno == errno.ENOSPC
        raise RunFailed(
            f"results cannot be written: {error}",
            where=str(path),
            next="make room and run the same command again" if full else None,
        ) from error


def keep_config(folder: Path, context: RunContext) -> None:
    """The resolved config beside the results that came of it; each evaluation has its own.

    Raises:
        OSError: it cannot be written.
    """
    if not context.config:  # built by hand, not from a config
        return
    tree = json.loads(json.dumps(context.config, default=str))
    origins = dict(sorted(context.origins.items()))
    write_json(folder / CONFIG_FILE, {"format": CONFIG_FORMAT, "config": tree, "origins": origins})


def seeds(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Group -> first and last seed of its episodes."""
    groups = dict.fromkeys(record["group"] for record in records)
    found = {name: [r["seed"] for r in records if r["group"] == name] for name in groups}
    return {name: [min(numbers), max(numbers)] for name, numbers in found.items()}


def timing(
    records: Sequence[Mapping[str, Any]], new: int, seconds: float, workers: int
) -> dict[str, Any]:
    """How fast the episodes were, as JSON values.

    Args:
        records: with ``steps``, ``calls`` (of the policy) and ``timing``: see ``run_episode``.
        new: how many of them this run made; where it is not all of them, only the policy's
            answer has a meaningful mean.
        seconds: this run's wall time.
        workers: this run's processes.
    """
    done = [r for r in records if r["status"] == DONE]
    calls = sum(r["calls"] for r in done)
    steps = sum(r["steps"] for r in done)

    def mean_ms(name: str, count: int) -> float:
        spent: float = sum(r["timing"].get(name, 0.0) for r in done)
        return 1e3 * spent / max(count, 1)

    found: dict[str, Any] = {
        "episodes": 0,
        "workers": workers,
        "policy_ms": mean_ms("policy_seconds", calls),
        "observe_ms": mean_ms("observe_seconds", calls),
        "step_ms": mean_ms("step_seconds", steps),
        "worker_memory_mb": max((r["timing"].get("memory_mb", 0.0) for r in done), default=0.0),
    }
    if new == len(records):
        per_s = steps / max(seconds, 1e-9)
        found |= {"episodes": new, "steps": steps, "seconds": seconds, "steps_per_s": per_s}
    return found


def ticks(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Statistics of the control ticks of live episodes, as JSON values.

    ``missed_share``: of all commands, those for which the policy had no target ready;
    ``skipped_beats`` and ``late_ticks`` are the machine's; ``stopped_by``: rule -> episodes.
    """
    done = [r for r in records if r["status"] == DONE]
    commands = sum(r["steps"] for r in done)
    rules = [rule for r in done for rule in r["trips"][:1]]
    return {
        "ticks": sum(r["ticks"] for r in done),
        "missed_ticks": sum(r["missed_ticks"] for r in done),
        "missed_share": sum(r["missed_ticks"] for r in done) / max(commands, 1),
        "skipped_beats": sum(r["skipped_beats"] or 0 for r in done),
        "late_ticks": sum(r["late_ticks"] for r in done),
        "stopped_by": {rule: rules.count(rule) for rule in dict.fromkeys(rules)},
    }


def check_any_done(records: Sequence[Mapping[str, Any]], log: Path) -> None:
    """Fail if every episode ended in an error.

    Raises:
        RunFailed: with the last episode's reason.
    """
    if not any(record["status"] == DONE for record in records):
        raise RunFailed(
            f"none of the {len(records)} episodes gave a result; the last one:\n"
            f"{records[-1]['error']}",
            where=str(log),
        )


def check_all_done(records: Sequence[Mapping[str, Any]], log: Path) -> None:
    """Fail if some episodes gave no result: the rates are not those of all episodes.

    Raises:
        RunFailed: with how many there are, and the last one's reason.
    """
    errors = [record for record in records if record["status"] != DONE]
    if errors:
        raise RunFailed(
            f"{len(errors)} of {len(records)} episodes gave no result, so the rates are of the "
            f"others alone; the last one: {reason(errors[-1]['error'])}",
            where=str(log),
            next="fix the cause and run the same command again: only these are tried again",
        )


def report_results(reporter: Reporter, results: Mapping[str, Any], folder: Path) -> None:
    """Report the rates of each group and task, problems, the speed, and the videos."""
    for group, found in results["groups"].items():
        for task, counted in found["tasks"].items():
            reporter.info(describe_rate(f"{group} {task}", counted))
        if len(found["tasks"]) > 1:
            reporter.info(describe_rate(f"{group} {all_of(len(found['tasks']))}", found["all"]))
    tested = results.get("instruction_test")
    if tested is not None:
        reporter.info(
            f"right against wrong instruction, {tested['pairs']} pairs, exact McNemar test: "
            f"p = {tested['p_different']:.2g}, {tested['verdict']}"
        )
    for row in results["problems"][:NAMED]:
        reporter.warn(describe_problem(row))
    if len(results["problems"]) > NAMED:
        reporter.warn(f"and {len(results['problems']) - NAMED} more problems: see results.json")
    speed = results["timing"]
    if speed["episodes"]:
        reporter.info(
            f"{speed['steps']} steps in {speed['seconds']:.0f} s: "
            f"{speed['steps_per_s']:.0f} steps/s in {speed['workers']} processes"
        )
    if "live" in results:
        live = results["live"]
        stopped = ", ".join(f"{rule} {count}" for rule, count in live["stopped_by"].items())
        reporter.info(
            f"live: {live['missed_share']:.1%} of {live['ticks']} ticks without a target of the "
            f"policy, {live['skipped_beats']} ticks skipped; stopped by safety: {stopped or 'none'}"
        )
    for video in results["videos"]:
        reporter.artifact("video", folder / video["path"])


# -- videos: failures show more than successes, so they come first

# Tasks whose groups are all shown.
_COMPARED = 2
# What results.json says of a video.
_VIDEO_KEYS = ("group", "task", "seed", "success", "instruction")


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


def with_others(
    shown: Sequence[Mapping[str, Any]], records: Sequence[Mapping[str, Any]]
) -> list[Mapping[str, Any]]:
    """``shown``, and one episode of each other group for its first tasks, to be seen beside it.

    One of the same seed where there is one.
    """
    best = {r["task"]: r for r in reversed(shown)} | {r["task"]: r for r in shown if r["success"]}
    groups = dict.fromkeys(r["group"] for r in records if r["status"] == DONE)
    found = list(shown)
    for task, record in list(best.items())[:_COMPARED]:
        for group in groups:
            mine = [r for r in records if (r["group"], r["task"]) == (group, task)]
            mine = [r for r in mine if r["status"] == DONE]
            if group != record["group"] and mine:
                found.append(min(mine, key=lambda r: r["seed"] != record["seed"]))
    return found


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
    """Run the episodes of ``records`` again to record videos: they repeat exactly.

    Args:
        pool: its workers return a result with ``state_hash``, as the records have it.
        folder: where the videos go; those of an evaluation before are removed.
        make_job: from a key and a path to the job that runs it and leaves its video there.

    Returns:
        JSON values, one for each video that was made, in the order of ``records``: ``group``,
        ``task``, ``seed``, ``success``, ``instruction`` and ``path``, relative to ``folder``'s
        parent.
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
            **{key: record[key] for key in _VIDEO_KEYS if key in record},
            "path": f"{folder.name}/{name}",
        }
        for record, name, there in zip(records, names, made, strict=True)
        if there
    ]


def recorded_videos(
    recordings: Iterable[tuple[Mapping[str, Any], Path]], folder: Path
) -> list[dict[str, Any]]:
    """The videos that were recorded while the episodes ran, as :func:`record_videos` lists its own.

    Args:
        recordings: each episode's record with the folder of its recording.
        folder: of the results, to which the videos' paths are relative.
    """
    return [
        {
            **{key: record[key] for key in _VIDEO_KEYS if key in record},
            "path": Path(os.path.relpath(video, folder)).as_posix(),
        }
        for record, place in recordings
        for video in sorted(place.glob("*.mp4"))[:1]
    ]


def _in_turn(records: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    seen: dict[str, int] = {}
    ranked = []
    for record in records:
        rank = seen.get(record["task"], 0)
        seen[record["task"]] = rank + 1
        ranked.append((rank, record))
    return [record for _, record in sorted(ranked, key=lambda pair: pair[0])]
