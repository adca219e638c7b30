"""Latencies of a run on a robot, as CSV: how long answers took, how regularly commands were sent.

An example of a hook: it names the methods that it wants to be called by, and of their arguments
those that it has a use for.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any, TextIO

from fluxvla_core import Hook, RunContext
from fluxvla_core.errors import ConfigError

__all__ = ["LatencyLog"]

COLUMNS = ("stamp_s", "episode", "kind", "seconds")


class LatencyLog(Hook):
    """Writes latencies as CSV: a row for each answer of the policy and each command.

    The columns are ``stamp_s`` (on the robot's clock), ``episode`` (from 1), ``kind`` and
    ``seconds``: for ``policy`` what an answer took, for ``command`` the time since the last command
    of the episode. Rows are appended, so that a work dir keeps those of all its runs.

    Args:
        file: where, in the work dir.
        every: write every N-th row of each kind.

    Raises:
        ConfigError: ``every`` is less than 1, or ``file`` leads out of the work dir.
    """

    api = "1.0"

    def __init__(self, file: str = "latency.csv", every: int = 1) -> None:
        if every < 1:
            raise ConfigError(f"LatencyLog: every must be at least 1, got {every}")
        if Path(file).is_absolute() or ".." in Path(file).parts:
            raise ConfigError(f"LatencyLog: file lies in the work dir, got {file!r}")
        self.file, self.every = file, every
        self._out: TextIO | None = None
        self._counts: dict[str, int] = {}
        self._episode = 0
        self._last: float | None = None

    def run_started(self, context: RunContext) -> None:
        path = Path(context.work_dir) / self.file
        path.parent.mkdir(parents=True, exist_ok=True)
        self._out = path.open("a", newline="", encoding="utf-8")
        if self._out.tell() == 0:
            csv.writer(self._out).writerow(COLUMNS)

    def episode_started(self) -> None:
        self._episode += 1
        self._last = None

    def inferred(self, latency_s: float, stamp: float) -> None:
        self._write(stamp, "policy", latency_s)

    def action_sent(self, stamp: float) -> None:
        if self._last is not None:
            self._write(stamp, "command", stamp - self._last)
        self._last = stamp

    def episode_finished(self) -> None:
        if self._out is not None:
            self._out.flush()

    def run_finished(self) -> None:
        if self._out is not None:
            self._out.close()
            self._out = None

    def _write(self, stamp: float, kind: str, seconds: float) -> None:
        count = self._counts[kind] = self._counts.get(kind, 0) + 1
        if self._out is not None and (count - 1) % self.every == 0:
            row: list[Any] = [f"{stamp:.6f}", self._episode, kind, f"{seconds:.6f}"]
            csv.writer(self._out).writerow(row)
