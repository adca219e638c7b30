"""Chooses the reporter of a run: JSON lines, text lines, or progress bars on a terminal."""

from __future__ import annotations

import sys
from typing import TextIO

from fluxvla_core.cli.reporters import JsonReporter, LineReporter, RunReporter


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
