"""Progress bars for a terminal. Imported only where there is one."""

from __future__ import annotations

from pathlib import Path
from typing import TextIO

from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from fluxvla_core.cli.reporters import shown


class RichReporter:
    """A bar for each named progress, lines above them."""

    def __init__(self, stream: TextIO) -> None:
        self._console = Console(file=stream)
        self._bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("[dim]{task.fields[beside]}"),
            console=self._console,
            refresh_per_second=4,
        )
        self._tasks: dict[str, TaskID] = {}

    def info(self, text: str) -> None:
        self._console.print(escape(text), highlight=False)

    def warn(self, text: str) -> None:
        self._console.print(f"[yellow]warning:[/yellow] {escape(text)}", highlight=False)

    def progress(self, name: str, done: int, total: int | None, **fields: object) -> None:
        if name not in self._tasks:
            self._bars.start()
            self._tasks[name] = self._bars.add_task(escape(name), total=total, beside="")
        self._bars.update(
            self._tasks[name], completed=done, total=total, beside=escape(shown(fields))
        )

    def settle(self) -> None:
        """Leave the terminal to whoever types: a bar would draw over it. The next one is new."""
        self._bars.stop()
        for task in self._tasks.values():
            self._bars.remove_task(task)
        self._tasks.clear()

    def event(self, kind: str, **fields: object) -> None:
        return

    def artifact(self, kind: str, path: Path) -> None:
        self.info(f"{kind}: {path}")

    def close(self) -> None:
        self._bars.stop()
