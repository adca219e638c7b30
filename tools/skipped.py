"""Skipped tests of the stages of ``nox -s tests``, gathered by the root conftest and listed."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

FILE = "FLUXVLA_SKIPPED"
"""An environment variable: where pytest appends what it skipped."""


def note(path: Path, skipped: Iterable[tuple[str, str]]) -> None:
    """Append (test or file, reason) pairs."""
    with path.open("a", encoding="utf-8") as out:
        for test, reason in skipped:
            out.write(json.dumps([test, reason]) + "\n")


def summary(path: Path) -> list[str]:
    """For each reason how many were skipped for it, and one of them."""
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
