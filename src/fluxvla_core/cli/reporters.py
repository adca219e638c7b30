"""What a run says: to people in a terminal, to a log file, or to a program."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol, TextIO

from fluxvla_core.contracts.reporter import Reporter

EVERY_S = 5.0
"""Seconds between two lines of one progress where lines stay (a log file, JSON)."""


class Talking(Reporter, Protocol):
    """A reporter that has to be closed, so that the terminal is left as it was found."""

    def close(self) -> None: ...


def make_reporter(log_format: str, stream: TextIO | None = None) -> Talking:
    """The reporter for ``--log-format``: ``json``, or ``text`` (bars where ``stream`` has a
    terminal behind it)."""
    out = sys.stdout if stream is None else stream
    if log_format == "json":
        return JsonReporter(out)
    if out.isatty():
        from fluxvla_core.cli.rich_reporter import RichReporter

        return RichReporter(out)
    return LineReporter(out)


class Pace:
    """Lets the first, the last, and one progress line every ``every`` seconds through."""

    def __init__(self, every: float = EVERY_S) -> None:
        self._every = every
        self._last: dict[str, float] = {}

    def due(self, name: str, done: int, total: int | None) -> bool:
        now = time.monotonic()
        last = self._last.get(name)
        if last is not None and now - last < self._every and done != total:
            return False
        self._last[name] = now
        return True


class LineReporter:
    """One line at a time, for files and pipes; each starts with the seconds since the start."""

    def __init__(self, stream: TextIO, every: float = EVERY_S) -> None:
        self._out = stream
        self._pace = Pace(every)
        self._start = time.monotonic()

    def _line(self, text: str) -> None:
        print(f"[{time.monotonic() - self._start:7.1f}s] {text}", file=self._out, flush=True)

    def info(self, text: str) -> None:
        self._line(text)

    def warn(self, text: str) -> None:
        self._line(f"warning: {text}")

    def progress(self, name: str, done: int, total: int | None, **fields: object) -> None:
        if self._pace.due(name, done, total):
            count = f"{done}/{total}" if total is not None else str(done)
            self._line("  ".join(filter(None, [f"{name} {count}", shown(fields)])))

    def event(self, kind: str, **fields: object) -> None:
        return

    def artifact(self, kind: str, path: Path) -> None:
        self._line(f"{kind}: {path}")

    def close(self) -> None:
        return


class JsonReporter:
    """One JSON object a line: ``time`` (seconds since the epoch), ``kind``, and its fields."""

    def __init__(self, stream: TextIO, every: float = EVERY_S) -> None:
        self._out = stream
        self._pace = Pace(every)

    def _record(self, kind: str, fields: Mapping[str, object]) -> None:
        record = {"time": round(time.time(), 3), "kind": kind, **fields}
        text = json.dumps(plain(record), ensure_ascii=False, allow_nan=False)
        print(text, file=self._out, flush=True)

    def info(self, text: str) -> None:
        self._record("info", {"text": text})

    def warn(self, text: str) -> None:
        self._record("warning", {"text": text})

    def progress(self, name: str, done: int, total: int | None, **fields: object) -> None:
        if self._pace.due(name, done, total):
            self._record("progress", {"name": name, "done": done, "total": total, **fields})

    def event(self, kind: str, **fields: object) -> None:
        self._record(kind, fields)

    def artifact(self, kind: str, path: Path) -> None:
        self._record("artifact", {"what": kind, "path": path})

    def close(self) -> None:
        return


def shown(fields: Mapping[str, object]) -> str:
    """``loss 0.1234  rate 1e-05``: what people read beside a progress."""
    return "  ".join(
        f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}"
        for name, value in fields.items()
        if value is not None
    )


def plain(value: Any) -> Any:
    """``value`` as JSON has it: numbers that JSON lacks become None, the rest its text."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if hasattr(value, "tolist"):  # numpy scalars and arrays, tensors
        return plain(value.tolist())
    return str(value)
