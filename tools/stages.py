"""Notes of the root conftest for the stages of ``nox -s tests``: later files, skipped tests.

Importing every test file takes a process ten seconds and more; the later stages need few of them,
which the collection of the first stage finds.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Set
from pathlib import Path

FILE = "FLUXVLA_STAGES"
"""An environment variable: where pytest writes which files have tests that it left out."""
SKIPPED = "FLUXVLA_SKIPPED"
"""An environment variable: where pytest appends the tests that it skipped."""


def note(path: Path, deselected: Iterable[tuple[Path, Set[str]]]) -> None:
    """Write the marks of each file's deselected tests, from (file, marks of the test) pairs."""
    found: dict[str, set[str]] = {}
    for file, marks in deselected:
        found.setdefault(str(file), set()).update(marks)
    text = json.dumps({file: sorted(marks) for file, marks in sorted(found.items())}, indent=1)
    path.write_text(text + "\n", encoding="utf-8")


def files(path: Path, mark: str) -> list[str]:
    """The files with deselected tests of a mark; empty, which is all files, where none was noted.

    A test with two marks counts for both, so this may name a file too many, never one too few.
    """
    if not path.exists():
        return []
    noted = json.loads(path.read_text(encoding="utf-8"))
    return [file for file, marks in noted.items() if mark in marks]


def note_skipped(path: Path, skipped: Iterable[tuple[str, str]]) -> None:
    """Append (test or file, reason) pairs."""
    with path.open("a", encoding="utf-8") as out:
        for test, reason in skipped:
            out.write(json.dumps([test, reason]) + "\n")


def summary(path: Path) -> list[str]:
    """For each reason the number of skipped tests, and one of them."""
    if not path.exists():
        return ["nothing was skipped"]
    reasons: dict[str, list[str]] = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        test, reason = json.loads(line)
        reasons.setdefault(reason, []).append(test)
    return [
        f"{len(tests)} skipped: {reason} ({tests[0]}{', …' if len(tests) > 1 else ''})"
        for reason, tests in sorted(reasons.items())
    ] or ["nothing was skipped"]
