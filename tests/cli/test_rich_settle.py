"""Bars make room for a person who types."""

from __future__ import annotations

import io

from fluxvla_core.cli.rich_reporter import RichReporter


def test_a_settled_bar_is_gone_and_the_next_one_is_new() -> None:
    reporter = RichReporter(io.StringIO())
    reporter.settle()
    reporter.progress("commands", 40, 100)
    assert reporter._bars.live.is_started
    reporter.settle()
    assert not reporter._bars.live.is_started
    assert reporter._bars.tasks == []

    reporter.progress("commands", 1, 100)
    assert [task.completed for task in reporter._bars.tasks] == [1]
    reporter.close()
