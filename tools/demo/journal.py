"""A demo's finished stages: written after every stage, so that it goes on where it stopped."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any


@dataclass
class Entry:
    """One stage: what it was started with, whether it is done, and how long it took so far (s)."""

    key: str
    done: bool = False
    seconds: float = 0.0
    command: str = ""
    result: Any = None


class Journal:
    """The stages of one demo, in a file of its folder.

    A file that cannot be read counts as empty: everything is done again.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.entries: dict[str, Entry] = {}
        try:
            rows = json.loads(path.read_text(encoding="utf-8"))
            self.entries = {name: Entry(**row) for name, row in rows.items()}
        except (OSError, ValueError, TypeError, AttributeError):
            self.entries = {}

    def forget_from(self, name: str) -> None:
        """Drop a stage and those after it: they are done again, and their time was another's."""
        names = list(self.entries)
        for later in names[names.index(name) :] if name in names else ():
            del self.entries[later]

    def save(self) -> None:
        """Write the file; a reader never sees half of it."""
        part = self.path.with_suffix(".part")
        rows = {name: asdict(entry) for name, entry in self.entries.items()}
        part.write_text(json.dumps(rows, indent=1), encoding="utf-8")
        os.replace(part, self.path)


def key_of(*parts: str | Sequence[str]) -> str:
    """A short text that changes when any of the parts does."""
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:16]
