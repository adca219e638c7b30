"""Progress bars for a terminal. Imported only where there is one."""

from __future__ import annotations

from pathlib import Path
from typing import TextIO

from rich import markup
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
)
from rich.table import Column
from rich.text import Text

from fluxvla_core.cli.reporters import RunReporter, clock, format_fields
from fluxvla_core.errors import printable

NARROW = 100
"""Columns of a terminal below which the bar is short."""


def escape(text: str) -> str:
    """``text`` as it stands: no markup, and nothing that steers the terminal."""
    return markup.escape(printable(text))


class Left(ProgressColumn):
    """``5:12 left``; what it took at the end; how long it has taken where nobody knows the end."""

    def render(self, task: Task) -> Text:
        if task.total is None or task.finished:
            return Text(clock(task.finished_time or task.elapsed or 0.0))
        left = "-:--" if task.time_remaining is None else clock(task.time_remaining)
        return Text(f"{left} left")


class Count(MofNCompleteColumn):
    """``12/300``, and nothing where the total is not known and nothing is counted."""

    def render(self, task: Task) -> Text:
        return Text("") if task.total is None and not task.completed else super().render(task)


class RichReporter(RunReporter):
    """A bar for each named progress, lines above them.

    Name, count, bar and time left are always there; the other fields have the rest of
    the line.
    """

    def __init__(self, stream: TextIO) -> None:
        self._console = Console(file=stream)
        whole, rest = Column(no_wrap=True), Column(no_wrap=True, ratio=1, overflow="ellipsis")
        self._bars = Progress(
            TextColumn("{task.description}", table_column=whole),
            Count(table_column=whole.copy()),
            BarColumn(bar_width=12 if self._console.width < NARROW else 24),
            Left(table_column=whole.copy()),
            TextColumn("[dim]{task.fields[details]}", table_column=rest),
            console=self._console,
            refresh_per_second=4,
            expand=True,
        )
        self._tasks: dict[str, TaskID] = {}
        self._silence: TaskID | None = None

    def info(self, text: str) -> None:
        self._console.print(escape(text), highlight=False)

    def warn(self, text: str) -> None:
        self._console.print(f"[yellow]warning:[/yellow] {escape(text)}", highlight=False)

    def progress(self, name: str, done: int, total: int | None, **fields: object) -> None:
        if name not in self._tasks:
            self._bars.start()
            self._tasks[name] = self._bars.add_task(escape(name), total=total, details="")
        self._bars.update(
            self._tasks[name], completed=done, total=total, details=escape(format_fields(fields))
        )

    def still_working(self, what: str, seconds: float) -> None:
        """Nothing was said for ``seconds`` since ``what``, and the work continues."""
        if self._silence is None:
            self._bars.start()
            self._silence = self._bars.add_task("working", total=None, details="")
        self._bars.update(self._silence, details=escape(f"since: {what}"))

    def end_silence(self) -> None:
        """The silence is over."""
        if self._silence is not None:
            self._bars.remove_task(self._silence)
            self._silence = None

    def settle(self) -> None:
        """Leave the terminal to a person who types: a bar would draw over it. The next is new."""
        self.end_silence()
        self._bars.stop()
        for task in self._tasks.values():
            self._bars.remove_task(task)
        self._tasks.clear()

    def artifact(self, kind: str, path: Path) -> None:
        self.info(f"{kind}: {path}")

    def close(self) -> None:
        self._bars.stop()
