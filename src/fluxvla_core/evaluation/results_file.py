"""``results.json`` of an evaluation: summary of the episodes, checks, writing and reporting."""

from __future__ import annotations

import errno
import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from statistics import mean
from typing import Any

from fluxvla_core import atomic
from fluxvla_core.build import RunContext
from fluxvla_core.config.load import CONFIG_FILE
from fluxvla_core.config.load import FORMAT as CONFIG_FORMAT
from fluxvla_core.contracts.runner import Reporter
from fluxvla_core.errors import RunFailed
from fluxvla_core.evaluation.episodes import DONE, EvalLog, reason
from fluxvla_core.evaluation.provenance import Code, provenance
from fluxvla_core.evaluation.success_rates import rate

FORMAT = "fluxvla-eval-1"
NAMED = 5
"""How many different problems are reported; all are in the results."""


def assemble(
    records: Sequence[Mapping[str, Any]],
    log: EvalLog,
    *,
    policy: str,
    mode: str,
    checkpoint: Mapping[str, Any] | None,
    settings: Mapping[str, Any],
    code: Code,
    videos: Sequence[Mapping[str, Any]],
    timing: Mapping[str, Any],
) -> dict[str, Any]:
    """The part of ``results.json`` that every evaluation has, in simulation or on a robot.

    Args:
        records: of all episodes, finished or failed.
        log: where they are from; says which ones other code ran.
        policy: its name: ``checkpoint``, ``expert``, a registered type, …
        mode: ``stepped``, ``live`` or ``robot``.
        checkpoint: ``path`` and ``sha256``; None for policies without one.
        settings: what outcomes follow from, for people.
        code: what ran the new episodes.
        videos, timing: see :mod:`fluxvla_core.evaluation.videos` and :func:`timing`.
    """
    return {
        "format": FORMAT,
        "policy": policy,
        "mode": mode,
        "groups": summarise(records),
        "problems": problems(records),
        "checkpoint": checkpoint,
        "settings": settings,
        "provenance": {
            **provenance(code),
            "seeds": seeds(records),
            "reused": {"episodes": len(log.reused), "changed": log.changed},
        },
        "videos": videos,
        "timing": timing,
    }


def save_results(folder: Path, results: Mapping[str, Any], context: RunContext) -> None:
    """Write ``results.json`` and the resolved config into ``folder``, and report the rates.

    Raises:
        RunFailed: the disk is full, or the folder was taken away.
    """
    write_results(folder / "results.json", results)
    if context.config:  # else the runner was built by hand
        tree, origins = as_json(context.config), dict(sorted(context.origins.items()))
        document = {"format": CONFIG_FORMAT, "config": tree, "origins": origins}
        atomic.write_json(folder / CONFIG_FILE, document)
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


def seeds(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Group -> first and last seed of its episodes."""
    groups = dict.fromkeys(record["group"] for record in records)
    found = {name: [r["seed"] for r in records if r["group"] == name] for name in groups}
    return {name: [min(numbers), max(numbers)] for name, numbers in found.items()}


def timing(
    records: Sequence[Mapping[str, Any]], new: int, seconds: float, workers: int
) -> dict[str, Any]:
    """Speed of the episodes, as JSON values.

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
    ``skipped_ticks`` and ``late_ticks`` are the machine's; ``stopped_by``: rule -> episodes.
    """
    done = [r for r in records if r["status"] == DONE]
    commands = sum(r["steps"] for r in done)
    rules = [rule for r in done for rule in r["trips"][:1]]
    return {
        "ticks": sum(r["ticks"] for r in done),
        "missed_ticks": sum(r["missed_ticks"] for r in done),
        "missed_share": sum(r["missed_ticks"] for r in done) / max(commands, 1),
        "skipped_ticks": sum(r["skipped_ticks"] or 0 for r in done),
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
            f"policy, {live['skipped_ticks']} ticks skipped; stopped by safety: {stopped or 'none'}"
        )
    for video in results["videos"]:
        reporter.artifact("video", folder / video["path"])


def flat(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """``{"operator": {"type": …}}`` as ``{"operator.type": …}``: rows for people."""
    rows: dict[str, Any] = {}
    for key, value in table.items():
        if isinstance(value, Mapping) and value:
            rows |= flat(value, f"{prefix}{key}.")
        else:
            rows[f"{prefix}{key}"] = value
    return rows


def as_json(table: Any) -> Any:
    """A config's table as plain JSON values, which can be sent to other processes."""
    return json.loads(json.dumps(table, default=_as_json_value))


def _as_json_value(value: Any) -> Any:
    return dict(value) if isinstance(value, Mapping) else str(value)


def summarise(records: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Success by group and task.

    Returns:
        ``{group: {"tasks": {task: rate}, "all": rate}}``, each ``rate`` as :func:`rate` gives it
        with ``errors`` added, and ``mean_return`` where episodes have a return. An episode that
        ended in an error is not a trial: it says nothing about the policy, and is counted apart.
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
    """Problems of episodes, the most frequent first, as JSON values.

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


def all_of(tasks: int) -> str:
    """The name of the row over several tasks: they may be few of those that there are."""
    return f"all {tasks} tasks" if tasks > 1 else "the task"


def describe_rate(name: str, counted: Mapping[str, Any]) -> str:
    """One line for people: ``lift_hold: 44/50 = 88 % (95 % interval 76 to 94 %)``."""
    if not counted["episodes"]:
        return f"{name}: no episode gave a result ({counted['errors']} errors)"
    errors = f", {counted['errors']} errors" if counted.get("errors") else ""
    share = f"{counted['successes']}/{counted['episodes']} = {counted['rate']:.0%}"
    ends = f"{counted['low']:.0%} to {counted['high']:.0%}"
    gained = f", mean return {counted['mean_return']:.4g}" if "mean_return" in counted else ""
    return f"{name}: {share} ({counted['confidence']:.0%} interval {ends}){gained}{errors}"


def _counted(records: list[Mapping[str, Any]]) -> dict[str, Any]:
    done = [record for record in records if record["status"] == DONE]
    successes = sum(bool(record["success"]) for record in done)
    counted = {**rate(successes, len(done)), "errors": len(records) - len(done)}
    returns = [record["return"] for record in done if record.get("return") is not None]
    return {**counted, "mean_return": mean(returns)} if returns else counted
