"""The summary of an episode, counted from its events: while it runs, or from its record."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from fluxvla_core.record.timings import Timings

FORMAT = "fluxvla-episode-1"
START, OBSERVATION, CHUNK, REFUSED = "start", "observation", "chunk", "refused"
COMMAND, STOP, END = "command", "stop", "end"
"""Values of an event's ``event``.

``start``: what runs on what (the first event); ``observation``: a reading that was looked at;
``chunk``: a policy's answer that was admitted; ``refused``: a reading or an answer that was not;
``command``: what was sent; ``stop``: a safe stop; ``end``: how it ended. All have ``t``, seconds on
the loop's clock.
"""


class Tally:
    """Counts events. ``summary`` is what ``episode.json`` holds."""

    def __init__(self) -> None:
        self._start: Mapping[str, Any] = {}
        self._end: Mapping[str, Any] = {}
        self._timings = Timings()
        self._clamps: dict[str, dict[str, int]] = {}
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
        for stage, value in (event.get("ms") or {}).items():
            if value is not None:
                self._timings.add(stage, value / 1e3)

    def summary(self) -> dict[str, Any]:
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
            "skipped_beats": end.get("skipped_beats"),
            "held_beats": self._held,
            "clamps": self._clamps,
            "trips": end.get("trips", []),
            "timings": self._timings.summary(),
        }

    def _count_clamps(self, clamps: Iterable[Mapping[str, Any]]) -> None:
        for clamp in clamps:
            counts = self._clamps.setdefault(clamp["joint"], {})
            counts[clamp["reason"]] = counts.get(clamp["reason"], 0) + 1


def summarise(events: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """The summary of recorded events."""
    tally = Tally()
    for event in events:
        tally.add(event)
    return tally.summary()
