"""Events of the process that commands a robot, in the format of an episode's log.

Apart from ``episode_log``, which readers of logs import without the engine; and from the recorder,
whose files and images the control process has no use for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from fluxvla_core.robot.events import CommandSent, EpisodeEnded, FilterSkipped, Stopped
from fluxvla_core.robot.recording import episode_log


def logged(event: CommandSent | FilterSkipped | Stopped | EpisodeEnded) -> dict[str, Any]:
    """``event`` as JSON values and arrays."""
    match event:
        case CommandSent(at, sent, phase, state, send_s, late_s):
            seconds = {"send": send_s, "late": late_s}
            return {
                "event": episode_log.COMMAND,
                "t": at,
                "phase": phase.value,
                "wanted": sent.target,
                "command": sent.command,
                "state": state,
                "clamps": [asdict(clamp) for clamp in sent.clamps],
                **({"held": True} if sent.held else {}),
                "ms": milliseconds({k: v for k, v in seconds.items() if v is not None}),
            }
        case FilterSkipped(at, name):
            return {"event": episode_log.FILTER, "t": at, "filter": name}
        case Stopped(at, rule, problem, seconds_, failure):
            return {
                "event": episode_log.STOP,
                "t": at,
                "rule": rule,
                "problem": problem,
                "seconds": seconds_,
                "failure": failure,
            }
        case EpisodeEnded(at, outcome, success, problem, skipped, trips):
            return {
                "event": episode_log.END,
                "t": at,
                "outcome": outcome,
                "success": success,
                "problem": problem,
                "skipped_ticks": skipped,
                "trips": [asdict(trip) for trip in trips],
            }


def milliseconds(seconds: Mapping[str, float]) -> dict[str, float]:
    """Seconds by stage as rounded milliseconds."""
    return {stage: round(value * 1e3, 3) for stage, value in seconds.items()}
