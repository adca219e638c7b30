"""Printing: escapes from files are shown, full disks and poor terminals cause no traceback."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fluxvla_core.cli.main import report
from fluxvla_core.cli.reporters import JsonReporter, LineReporter
from fluxvla_core.cli.rich_reporter import RichReporter
from fluxvla_core.errors import DataError, printable

NASTY = "a\x1b[2J\x9b31m\u202eb\r\ud800"
SHOWN = r"a\x1b[2J\x9b31m\u202eb\r\ud800"


def run(*words: str, out: object = subprocess.PIPE, **environment: str) -> tuple[int, bytes, bytes]:
    done = subprocess.run(
        [sys.executable, "-m", "fluxvla_core", *words],
        stdout=out,  # type: ignore[call-overload]
        stderr=subprocess.PIPE,
        env={**os.environ, **environment},
        timeout=120,
    )
    return done.returncode, done.stdout or b"", done.stderr


def test_what_steers_a_terminal_is_shown() -> None:
    assert printable(NASTY) == SHOWN
    assert printable("Grüße,\t→\n東京 🤖") == "Grüße,\t→\n東京 🤖"


def test_errors_and_reports_do_not_steer_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    assert report(DataError(f"no task {NASTY}")) == 2
    assert capsys.readouterr().err == f"no task {SHOWN}\n"
    for reporter in (LineReporter, RichReporter):
        stream = io.StringIO()
        made = reporter(stream)
        made.info(NASTY)
        made.warn(NASTY)
        made.close()
        assert stream.getvalue().count(SHOWN) == 2


def test_json_stays_json_whatever_the_encoding() -> None:
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii", errors="backslashreplace")
    JsonReporter(stream).info("Grüße")
    assert b'"Gr\\u00fc\\u00dfe"' in stream.buffer.getvalue()  # type: ignore[attr-defined]


@pytest.mark.parametrize("words", [("--help",), ("plugins", "list")], ids=" ".join)
def test_a_full_disk_behind_stdout_is_said_in_one_line(words: tuple[str, ...]) -> None:
    with open("/dev/full", "wb") as full:
        code, _, said = run(*words, out=full)
    assert (code, said) == (1, b"the output cannot be written: No space left on device\n")


def test_an_ascii_terminal_is_enough(tmp_path: Path) -> None:
    config = tmp_path / "größe.toml"
    config.write_text('model = {type = "東京"}\n')
    ascii_only = {"PYTHONIOENCODING": "ascii:strict", "LANG": "C"}
    code, out, said = run("config", "show", str(config), **ascii_only)
    assert (code, said) == (0, b"")
    assert rb"\u6771\u4eac" in out
    code, _, said = run("config", "check", str(config), **ascii_only)
    assert code == 2
    assert b"Traceback" not in said
    assert rb"gr\xf6\xdfe.toml" in said


def test_a_closed_stream_is_the_null_device(tmp_path: Path) -> None:
    """Or the next file would get its number, and be the stdin of a process that is started."""
    found = tmp_path / "found"
    program = (
        "import os, sys; from fluxvla_core.cli.terminal import prepare; prepare();"
        "number = os.open('/dev/zero', os.O_RDONLY); print('nobody', file=sys.stdout);"
        "said = sys.stdin.read(), sys.stdout.isatty(), sys.stderr.isatty(), number > 2;"
        f"open({str(found)!r}, 'w').write(repr(said))"
    )
    line = ["sh", "-c", '"$@" <&- >&- 2>&-', "sh", sys.executable, "-c", program]

    assert subprocess.run(line, timeout=60).returncode == 0
    assert found.read_text() == repr(("", False, False, True))
