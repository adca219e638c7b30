"""``results.json`` of an evaluation: what every evaluation runner writes alike."""

from __future__ import annotations

import errno
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fluxvla_core import atomic
from fluxvla_core.contracts.reporter import Reporter
from fluxvla_core.errors import RunFailed
from fluxvla_core.evaluate.ledger import DONE
from fluxvla_core.evaluate.summary import describe, describe_problem, reason

FORMAT = "fluxvla-eval-1"
NAMED = 5
"""How many different problems are told; all are in the results."""


def write_results(path: Path, results: Mapping[str, Any]) -> None:
    """Write JSON, so that what is there is whole.

    Raises:
        RunFailed: the disk is full, or the folder was taken away.
    """
    try:
        atomic.write_text(path, json.dumps(results, indent=1) + "\n")
    except OSError as error:
        full = error.errno == errno.ENOSPC
        raise RunFailed(
            f"results cannot be written: {error}",
            where=str(path),
            next="make room and run the same command again" if full else None,
        ) from error


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
    """What became of the ticks of live episodes, as JSON values.

    ``missed_share``: of all beats, those at which the policy had no target ready;
    ``skipped_beats`` and ``late_ticks`` are the machine's; ``stopped_by``: rule -> episodes.
    """
    done = [r for r in records if r["status"] == DONE]
    beats = sum(r["steps"] for r in done)
    rules = [rule for r in done for rule in r["trips"][:1]]
    return {
        "ticks": sum(r["ticks"] for r in done),
        "missed_ticks": sum(r["missed_ticks"] for r in done),
        "missed_share": sum(r["missed_ticks"] for r in done) / max(beats, 1),
        "skipped_beats": sum(r["skipped_beats"] or 0 for r in done),
        "late_ticks": sum(r["late_ticks"] for r in done),
        "stopped_by": {rule: rules.count(rule) for rule in dict.fromkeys(rules)},
    }


def check_any_done(records: Sequence[Mapping[str, Any]], ledger: Path) -> None:
    """Refuse to call it a result when every episode ended in an error.

    Raises:
        RunFailed: with the last episode's reason.
    """
    if not any(record["status"] == DONE for record in records):
        raise RunFailed(
            f"none of the {len(records)} episodes gave a result; the last one:\n"
            f"{records[-1]['error']}",
            where=str(ledger),
        )


def check_all_done(records: Sequence[Mapping[str, Any]], ledger: Path) -> None:
    """Let nobody take rates for those of all episodes when some gave no result.

    Raises:
        RunFailed: with how many there are, and the last one's reason.
    """
    errors = [record for record in records if record["status"] != DONE]
    if errors:
        raise RunFailed(
            f"{len(errors)} of {len(records)} episodes gave no result, so the rates are of the "
            f"others alone; the last one: {reason(errors[-1]['error'])}",
            where=str(ledger),
            next="mend what it says and run the same command again: only these are tried again",
        )


def tell(reporter: Reporter, results: Mapping[str, Any], folder: Path) -> None:
    """Say the rates of each group and task, what went wrong, the speed, where the videos are."""
    for group, found in results["groups"].items():
        for task, counted in found["tasks"].items():
            reporter.info(describe(f"{group} {task}", counted))
        if len(found["tasks"]) > 1:
            reporter.info(describe(f"{group} all tasks", found["all"]))
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
            f"policy, {live['skipped_beats']} beats skipped; stopped by safety: {stopped or 'none'}"
        )
    for video in results["videos"]:
        reporter.artifact("video", folder / video["path"])
