"""Files with tests of the later stages of ``nox -s tests``, found by the first one's collection.

To import every test file takes a process ten seconds and more; the later stages need few of them.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Set
from pathlib import Path

FILE = "FLUXVLA_STAGES"
"""An environment variable: where pytest writes which files have tests that it left out."""


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
