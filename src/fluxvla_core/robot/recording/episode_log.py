"""The format of an episode's log: its events, and the summary that is counted from them."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

from fluxvla_core.bounds import Finite
from fluxvla_core.errors import DataError
from fluxvla_core.untrusted import parse_json

# Buckets of ``Timings`` for a factor of e: each is half a percent wide.
_BUCKETS = 200
_SHORTEST_S = 1e-6


class Timings:
    """Stage -> histogram of durations. Stages appear in the report in the order of their first.

    The buckets are logarithmic, so that memory does not grow with the length of an episode and
    every percentile is within a quarter of a percent. Durations below 1 us count as 0.
    """

    def __init__(self) -> None:
        self._counts: dict[str, Counter[float]] = {}
        self._longest: dict[str, float] = {}

    def add(self, stage: str, seconds: float) -> None:
        """Note one duration."""
        short = seconds < _SHORTEST_S
        bucket = -math.inf if short else round(math.log(seconds) * _BUCKETS)
        self._counts.setdefault(stage, Counter())[bucket] += 1
        self._longest[stage] = max(seconds, self._longest.get(stage, 0.0))

    def summary(self) -> dict[str, dict[str, float]]:
        """stage -> ``count`` and ``p50_ms``, ``p95_ms``, ``p99_ms``, ``max_ms``."""
        report: dict[str, dict[str, float]] = {}
        for stage, counts in self._counts.items():
            longest = self._longest[stage]
            buckets = sorted(counts)
            up_to = list(accumulate(counts[bucket] for bucket in buckets))
            report[stage] = {"count": up_to[-1]}
            for percent in (50, 95, 99):
                rank = math.ceil(up_to[-1] * percent / 100)
                value = math.exp(buckets[bisect_left(up_to, rank)] / _BUCKETS)
                report[stage][f"p{percent}_ms"] = round(min(value, longest) * 1e3, 3)
            report[stage]["max_ms"] = round(longest * 1e3, 3)
        return report


FORMAT = "fluxvla-episode-1"
HELD = "held.jsonl"
"""What went wrong after an episode, while the arm was held: the episode's record is complete."""
START, OBSERVATION, CHUNK, REFUSED = "start", "observation", "chunk", "refused"
COMMAND, FILTER, STOP, END = "command", "filter", "stop", "end"
"""Values of an event's ``event``.

``start``: what runs on what (the first event); ``observation``: what a query or its history showed;
``chunk``: a policy's answer that passed its checks; ``refused``: an observation or an answer that
did not; ``command``: what was sent; ``filter``: an action filter was late, and is left out of the
command that comes next; ``stop``: a safe stop; ``end``: how it ended. All have ``t``, seconds on
the loop's clock.
"""


@dataclass(frozen=True)
class _Clamp:
    joint: str
    reason: str


@dataclass(frozen=True)
class _Event:
    """The types of what is read of events; which of them has what is in the text above."""

    event: str
    t: Finite
    state: list[float] | None = None
    command: list[float] | None = None
    stamps: dict[str, float] | None = None
    phase: str | None = None
    ms: dict[str, float | None] | None = None
    clamps: list[_Clamp] | None = None
    keyframes: list[list[float]] | None = None
    embodiment: dict[str, Any] | None = None
    instruction: str | None = None
    native: bool | None = None
    filter: str | None = None
    success: bool | None = None


def parse_event(text: bytes | str, where: str) -> dict[str, Any]:
    """One event of a record that somebody else may have written.

    Raises:
        DataError: it is none, or a value is of another type.
    """
    event = parse_json(text, dict[str, Any], DataError, where)
    parse_json(text, _Event, DataError, where)
    return event


class EpisodeSummary:
    """Counts an episode's events; ``to_dict`` is what ``episode.json`` holds."""

    def __init__(self) -> None:
        self._start: Mapping[str, Any] = {}
        self._end: Mapping[str, Any] = {}
        self._timings = Timings()
        self._clamps: dict[str, dict[str, int]] = {}
        self._late_filters: dict[str, int] = {}
        self._chunks = 0
        self._steps = 0
        self._held = 0

    def add(self, event: Mapping[str, Any]) -> None:
        """Count one event."""
        kind = event.get("event")
        if kind == START:
            self._start = event
        elif kind == END:
            self._end = event
        elif kind == CHUNK:
            self._chunks += 1
        elif kind == COMMAND:
            self._steps += event.get("phase") == "run"
            self._held += event.get("phase") == "run" and bool(event.get("held"))
            self._count_clamps(event.get("clamps") or ())
        elif kind == FILTER:
            name = str(event.get("filter"))
            self._late_filters[name] = self._late_filters.get(name, 0) + 1
        for stage, value in (event.get("ms") or {}).items():
            if value is not None:
                self._timings.add(stage, value / 1e3)

    def to_dict(self) -> dict[str, Any]:
        """JSON values; without an ``end`` event the outcome is ``cut short``."""
        start, end = self._start, self._end
        embodiment = start.get("embodiment") or {}
        return {
            "format": FORMAT,
            "task": start.get("task"),
            "instruction": start.get("instruction"),
            "outcome": end.get("outcome", "cut short"),
            "success": end.get("success"),
            "problem": end.get("problem") if end else "the record ends without an end",
            "steps": self._steps,
            "chunks": self._chunks,
            "seed": start.get("seed"),
            "robot": start.get("robot"),
            "embodiment": embodiment.get("name"),
            "joints": [joint.get("name") for joint in embodiment.get("joints", ())],
            "rate_hz": start.get("rate_hz"),
            "lockstep": start.get("lockstep"),
            # Version 0.1 wrote ``skipped_beats`` and ``held_beats``.
            "skipped_ticks": end.get("skipped_ticks", end.get("skipped_beats")),
            "held_ticks": self._held,
            "clamps": self._clamps,
            "late_filters": self._late_filters,
            "trips": end.get("trips", []),
            "timings": self._timings.summary(),
        }

    def _count_clamps(self, clamps: Iterable[Mapping[str, Any]]) -> None:
        for clamp in clamps:
            counts = self._clamps.setdefault(clamp["joint"], {})
            counts[clamp["reason"]] = counts.get(clamp["reason"], 0) + 1


def summarise(events: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """The summary of recorded events."""
    summary = EpisodeSummary()
    for event in events:
        summary.add(event)
    return summary.to_dict()
