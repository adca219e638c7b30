"""What reporters print, and how often."""

from __future__ import annotations

import fcntl
import io
import json
import os
import pty
import re
import struct
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fluxvla_core.cli import reporters
from fluxvla_core.cli.reporters import (
    EVERY_S,
    JsonReporter,
    KeepAliveReporter,
    LineReporter,
    Throttle,
    format_fields,
    json_values,
)
from fluxvla_core.commands import make_reporter


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
    pace = Throttle(1e9)
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


def test_a_silence_is_broken_and_a_person_who_types_is_left_alone() -> None:
    out = io.StringIO()
    reporter = KeepAliveReporter(LineReporter(out), every=0.2)
    reporter.info("evaluating a\nsecond line")
    until(lambda: out.getvalue().count("s since: evaluating a") >= 2)
    reporter.progress("episodes", 1, 4)
    until(lambda: "s since: episodes 1/4" in out.getvalue())
    reporter.settle()
    reporter.info("task id or instruction:")
    before = out.getvalue()
    time.sleep(0.6)
    assert out.getvalue() == before
    reporter.progress("commands", 1, 300)
    until(lambda: "s since: commands 1/300" in out.getvalue())
    reporter.close()
    assert "fluxvla-keep-alive" not in {thread.name for thread in threading.enumerate()}


def test_nobody_waits_longer_than_five_seconds_for_a_word() -> None:
    assert EVERY_S <= 5.0
    assert KeepAliveReporter.__init__.__defaults__ == (EVERY_S, "start")


def test_a_silence_for_machines() -> None:
    out = io.StringIO()
    reporter = KeepAliveReporter(JsonReporter(out), every=0.2)
    until(lambda: "still" in out.getvalue())
    reporter.close()
    record = json.loads(out.getvalue().splitlines()[0])
    assert (record["kind"], record["what"]) == ("still", "start")
    assert record["seconds"] >= 0.2


def until(holds: Callable[[], bool]) -> None:
    limit = time.monotonic() + 20
    while not holds():
        assert time.monotonic() < limit
        time.sleep(0.02)


METRICS = {
    "epoch": 0.4,
    "loss": 0.3166,
    "grad_norm": 0.8021,
    "lr": 0.0001726,
    "step_time": 0.4683,
    "samples_per_s": 34.16,
    "data_wait": 0.01903,
    "memory_gb": 0.8033,
}


@pytest.mark.parametrize("columns", [80, 100, 140])
def test_count_bar_and_time_left_stay_where_the_terminal_is_narrow(columns: int) -> None:
    """In a terminal of its own: the program that draws runs behind a real pty."""
    code = (
        "import sys, time\n"
        "from fluxvla_core.cli.choose_reporter import make_reporter\n"
        "from fluxvla_core.cli.reporters import KeepAliveReporter\n"
        "reporter = KeepAliveReporter(make_reporter('text'), every=0.4)\n"
        "for step in range(340, 344):\n"
        "    time.sleep(0.3)\n"
        f"    reporter.progress('train', step, 894, **{METRICS!r})\n"
        "time.sleep(3.0)\n"
        "reporter.close()\n"
    )
    text = behind_a_terminal([sys.executable, "-c", code], columns)
    drawn = [re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", part) for part in re.split(r"[\r\n]+", text)]
    drawn = [line for line in drawn if line.startswith("train")]
    assert drawn
    assert {len(line) for line in drawn if len(line) > columns} == set()
    last = drawn[-1]
    assert re.match(r"train +343/894 ━.*━ +\d+:\d\d left ", last)
    assert "loss 0.3166" in last
    assert last.rstrip().endswith("…")
    assert "working" in text
    assert "since: train 343/894" in text


def behind_a_terminal(command: list[str], columns: int) -> str:
    own, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 30, columns, 0, 0))
    unset = {"COLUMNS", "LINES", "NO_COLOR"}
    environment = {k: v for k, v in os.environ.items() if k not in unset}
    environment["TERM"] = "xterm-256color"
    child = subprocess.Popen(command, stdout=theirs, stdin=theirs, env=environment)
    os.close(theirs)
    parts: list[bytes] = []
    while True:
        try:
            part = os.read(own, 65536)
        except OSError:  # EIO: nobody holds the other end any more
            break
        if not part:
            break
        parts.append(part)
    os.close(own)
    assert child.wait(60) == 0
    return b"".join(parts).decode()


def test_values() -> None:
    assert format_fields({"a": 1, "b": 123456.789, "c": None}) == "a 1  b 1.235e+05"
    assert json_values({1: (float("inf"), {2})}) == {"1": [None, "{2}"]}
