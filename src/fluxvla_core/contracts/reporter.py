"""Progress and messages of a run: what work reports, for people and for programs."""

from __future__ import annotations

from pathlib import Path


class Reporter:
    """Receives the messages and progress of a run; this base class drops them all.

    Only rank 0 of a distributed run has one that shows anything.
    """

    def info(self, text: str) -> None:
        """One line for people."""

    def warn(self, text: str) -> None:
        """One line that somebody should read."""

    def progress(self, name: str, done: int, total: int | None, **fields: object) -> None:
        """``done`` of ``total`` units of ``name``; ``fields`` are shown next to it."""

    def event(self, kind: str, **fields: object) -> None:
        """One record for programs; ``fields`` are JSON values."""

    def artifact(self, kind: str, path: Path) -> None:
        """A file or folder that the run made and that somebody will look for."""

    def settle(self) -> None:
        """Leave the terminal to a person who is asked something: remove what draws on it."""


class SilentReporter(Reporter):
    """Drops everything: the default, and what ranks other than 0 get."""
