"""Reporters: progress and messages for a terminal, a log file, or a program (JSON)."""

from __future__ import annotations

import json
import math
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from fluxvla_core.cli.terminal import say
from fluxvla_core.contracts.runner import Reporter

EVERY_S = 4.0
"""Seconds between two lines of one progress where lines stay (a log file, JSON)."""


class RunReporter(Reporter):
    """A reporter of the command line: one that is closed, so that the terminal stays usable."""

    def still_working(self, what: str, seconds: float) -> None:
        """Nothing was reported for ``seconds`` since ``what``, and the work continues."""

    def end_silence(self) -> None:
        """Something is reported again."""

    def close(self) -> None:
        """Leave the terminal as it was found."""


class KeepAliveReporter(RunReporter):
    """Passes reports on to another reporter, with a heartbeat where none came for a while.

    Loading a model, or an episode that is long, are silent by themselves. After :meth:`settle`,
    when a person is waited for, it says nothing before the next progress.

    Args:
        every: seconds of silence before the first heartbeat, and between two.
        what: what goes on before the first report.
    """

    def __init__(self, inner: RunReporter, every: float = EVERY_S, what: str = "start") -> None:
        self._inner = inner
        self._every = every
        self._lock = threading.RLock()
        self._what = what
        self._last_report = self._last_line = time.monotonic()
        self._quiet = False
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="fluxvla-keep-alive", daemon=True)
        self._thread.start()

    def info(self, text: str) -> None:
        with self._reported(text):
            self._inner.info(text)

    def warn(self, text: str) -> None:
        with self._reported(text):
            self._inner.warn(text)

    def progress(self, name: str, done: int, total: int | None, **fields: object) -> None:
        with self._reported(f"{name} {_count(done, total)}"):
            self._quiet = False
            self._inner.progress(name, done, total, **fields)

    def event(self, kind: str, **fields: object) -> None:
        self._inner.event(kind, **fields)

    def artifact(self, kind: str, path: Path) -> None:
        with self._reported(f"{kind}: {path}"):
            self._inner.artifact(kind, path)

    def settle(self) -> None:
        with self._lock:
            self._quiet = True
            self._inner.settle()

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        self._inner.close()

    @contextmanager
    def _reported(self, what: str) -> Iterator[None]:
        with self._lock:
            self._inner.end_silence()
            yield
            self._what = what.partition("\n")[0]
            self._last_report = self._last_line = time.monotonic()

    def _watch(self) -> None:
        while not self._ended.wait(self._every / 8):
            with self._lock:
                now = time.monotonic()
                if self._quiet or now - self._last_line < self._every:
                    continue
                self._last_line = now
                try:
                    self._inner.still_working(self._what, now - self._last_report)
                except (OSError, ValueError):  # nobody reads any more: the next report fails
                    return


@contextmanager
def heartbeat(what: str, every: float = EVERY_S) -> Iterator[None]:
    """Lines on stderr as long as the block takes, for commands that print their result alone.

    A block that takes less than ``every`` seconds prints none.
    """
    reporter = KeepAliveReporter(LineReporter(sys.stderr), every, what)
    try:
        yield
    finally:
        reporter.close()


def make_reporter(log_format: str, stream: TextIO | None = None) -> RunReporter:
    """The reporter for ``--log-format``: ``json``, or ``text`` (bars where ``stream`` has a
    terminal behind it)."""
    out = sys.stdout if stream is None else stream
    if log_format == "json":
        return JsonReporter(out)
    if out.isatty():
        from fluxvla_core.cli.rich_reporter import RichReporter

        return RichReporter(out)
    return LineReporter(out)


class Throttle:
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


class LineReporter(RunReporter):
    """One line at a time, for files and pipes; each starts with the seconds since the start."""

    def __init__(self, stream: TextIO, every: float = EVERY_S) -> None:
        self._out = stream
        self._throttle = Throttle(every)
        self._start = time.monotonic()

    def _line(self, text: str) -> None:
        say(f"[{time.monotonic() - self._start:7.1f}s] {text}", self._out)

    def info(self, text: str) -> None:
        self._line(text)

    def warn(self, text: str) -> None:
        self._line(f"warning: {text}")

    def progress(self, name: str, done: int, total: int | None, **fields: object) -> None:
        if self._throttle.due(name, done, total):
            head = f"{name} {_count(done, total)}"
            self._line("  ".join(filter(None, [head, format_fields(fields)])))

    def artifact(self, kind: str, path: Path) -> None:
        self._line(f"{kind}: {path}")

    def still_working(self, what: str, seconds: float) -> None:
        self._line(f"… {seconds:.0f} s since: {what}")


class JsonReporter(RunReporter):
    """One JSON object a line: ``time`` (seconds since the epoch), ``kind``, and its fields."""

    def __init__(self, stream: TextIO, every: float = EVERY_S) -> None:
        self._out = stream
        # A byte that another encoding puts in would not be JSON; its own escapes are.
        self._ascii = (stream.encoding or "utf-8").lower().replace("-", "") != "utf8"
        self._throttle = Throttle(every)

    def _record(self, kind: str, fields: Mapping[str, object]) -> None:
        record = {"time": round(time.time(), 3), "kind": kind, **fields}
        say(json.dumps(json_values(record), ensure_ascii=self._ascii, allow_nan=False), self._out)

    def info(self, text: str) -> None:
        self._record("info", {"text": text})

    def warn(self, text: str) -> None:
        self._record("warning", {"text": text})

    def progress(self, name: str, done: int, total: int | None, **fields: object) -> None:
        if self._throttle.due(name, done, total):
            self._record("progress", {"name": name, "done": done, "total": total, **fields})

    def event(self, kind: str, **fields: object) -> None:
        self._record(kind, fields)

    def artifact(self, kind: str, path: Path) -> None:
        self._record("artifact", {"what": kind, "path": path})

    def still_working(self, what: str, seconds: float) -> None:
        self._record("still", {"what": what, "seconds": round(seconds, 1)})


def clock(seconds: float) -> str:
    """``4:05``, ``1:02:33``."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _count(done: int, total: int | None) -> str:
    return str(done) if total is None else f"{done}/{total}"


def format_fields(fields: Mapping[str, object]) -> str:
    """``loss 0.1234  rate 1e-05``: a progress line's fields for people."""
    return "  ".join(
        f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}"
        for name, value in fields.items()
        if value is not None
    )


def json_values(value: Any) -> Any:
    """``value`` as JSON has it: numbers that JSON lacks become None, the rest its text."""
    if isinstance(value, Mapping):
        return {str(k): json_values(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_values(v) for v in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if hasattr(value, "tolist"):  # numpy scalars and arrays, tensors
        return json_values(value.tolist())
    return str(value)
