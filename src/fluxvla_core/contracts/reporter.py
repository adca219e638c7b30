"""How long work tells people, and machines, where it is."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol


class Reporter(Protocol):
    """Where a run says what it does. Only rank 0 of a distributed run has one that talks."""

    def info(self, text: str) -> None:
        """One line for people."""

    def warn(self, text: str) -> None:
        """One line that somebody should read."""

    def progress(self, name: str, done: int, total: int | None, **fields: object) -> None:
        """``done`` of ``total`` units of ``name``; ``fields`` are shown beside it."""

    def event(self, kind: str, **fields: object) -> None:
        """One record for machines; ``fields`` are JSON values."""

    def artifact(self, kind: str, path: Path) -> None:
        """A file or folder that the run made and that somebody will look for."""

    def settle(self) -> None:
        """Leave the terminal to whoever types: a question comes next."""


class SilentReporter:
    """Drops everything: the default, and what ranks other than 0 get."""

    def info(self, text: str) -> None:
        return

    def warn(self, text: str) -> None:
        return

    def progress(self, name: str, done: int, total: int | None, **fields: object) -> None:
        return

    def event(self, kind: str, **fields: object) -> None:
        return

    def artifact(self, kind: str, path: Path) -> None:
        return

    def settle(self) -> None:
        return
