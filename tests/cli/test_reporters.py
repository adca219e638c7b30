"""What reporters print, and how often."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest

from fluxvla_core.cli import reporters
from fluxvla_core.cli.reporters import (
    JsonReporter,
    LineReporter,
    Pace,
    make_reporter,
    plain,
    shown,
)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def lines(stream: io.StringIO) -> list[str]:
    return [line.partition("] ")[2] for line in stream.getvalue().splitlines()]


def test_which_reporter() -> None:
    assert isinstance(make_reporter("json", Terminal()), JsonReporter)
    assert isinstance(make_reporter("text", io.StringIO()), LineReporter)
    assert type(make_reporter("text", Terminal())).__name__ == "RichReporter"


def test_lines_for_files() -> None:
    out = io.StringIO()
    reporter = LineReporter(out)
    reporter.info("hello")
    reporter.warn("careful")
    reporter.progress("train", 1, None, loss=0.123456, rate=1e-5, note="x", gone=None)
    reporter.event("start", section="runner")
    reporter.artifact("video", Path("a.mp4"))
    reporter.close()
    assert lines(out) == [
        "hello",
        "warning: careful",
        "train 1  loss 0.1235  rate 1e-05  note x",
        "video: a.mp4",
    ]
    assert out.getvalue().startswith("[    0.")


def test_progress_is_paced(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(reporters.time, "monotonic", lambda: now[0])
    out = io.StringIO()
    reporter = LineReporter(out, every=5)
    for step in range(1, 21):
        reporter.progress("train", step, 20)
        reporter.progress("other", step, None)
        now[0] += 1
    assert lines(out) == [
        "train 1/20",
        "other 1",
        "train 6/20",
        "other 6",
        "train 11/20",
        "other 11",
        "train 16/20",
        "other 16",
        "train 20/20",
    ]


def test_the_last_step_is_never_left_out() -> None:
    pace = Pace(1e9)
    assert [pace.due("a", n, 3) for n in (1, 2, 3)] == [True, False, True]


def test_json_lines() -> None:
    out = io.StringIO()
    reporter = JsonReporter(out, every=0)
    reporter.info("hellö")
    reporter.warn("careful")
    reporter.progress("train", 1, 2, loss=float("nan"))
    reporter.event("result", value=np.float32(0.5), curve=np.array([1, 2]), at=Path("x"))
    reporter.artifact("video", Path("a.mp4"))
    reporter.close()
    records = [json.loads(line) for line in out.getvalue().splitlines()]
    assert all(r.pop("time") > 0 for r in records)
    assert records == [
        {"kind": "info", "text": "hellö"},
        {"kind": "warning", "text": "careful"},
        {"kind": "progress", "name": "train", "done": 1, "total": 2, "loss": None},
        {"kind": "result", "value": 0.5, "curve": [1, 2], "at": "x"},
        {"kind": "artifact", "what": "video", "path": "a.mp4"},
    ]


def test_json_progress_is_paced() -> None:
    out = io.StringIO()
    reporter = JsonReporter(out)
    for step in range(100):
        reporter.progress("train", step, None)
    assert len(out.getvalue().splitlines()) == 1


def test_a_terminal_gets_bars_and_plain_text() -> None:
    out = Terminal()
    reporter = make_reporter("text", out)
    reporter.info("a [b] c")
    reporter.warn("[red]careful")
    reporter.progress("train [x]", 1, 2, loss=0.5)
    reporter.progress("train [x]", 2, 2, loss=0.25)
    reporter.event("start", section="runner")
    reporter.artifact("video", Path("[a].mp4"))
    reporter.close()
    text = out.getvalue()
    for part in ("a [b] c", "[red]careful", "train [x]", "2/2", "loss 0.25", "video: [a].mp4"):
        assert part in text, part


def test_values() -> None:
    assert shown({"a": 1, "b": 123456.789, "c": None}) == "a 1  b 1.235e+05"
    assert plain({1: (float("inf"), {2})}) == {"1": [None, "{2}"]}
