"""The file of finished episodes: one JSON object a line, on the disk as soon as it is known.

Its first line says what was evaluated. Whoever starts the same evaluation again goes on where it
ended, however it ended; another evaluation never counts what it finds there.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fluxvla_core.errors import RunFailed

FORMAT = "fluxvla-episodes-1"
DONE, ERROR = "done", "error"


@dataclass(frozen=True, order=True)
class EpisodeKey:
    """What an episode's outcome follows from, within one evaluation.

    Args:
        group: who acts and what it is told: ``policy``, ``swapped``, ``untrained``, …
        task: the task whose scene and success are meant.
        seed: of everything random in the episode.
    """

    group: str
    task: str
    seed: int


class Ledger:
    """Finished episodes in ``path``.

    Args:
        path: the file; its folder is made if need be.
        what: what is evaluated, as JSON values. A file that was written about something else is
            set aside under a name of its own.
        beside: a pattern of file names in the same folder, where others keep episodes of the same
            evaluation; what they have finished is finished here, too.

    Attributes:
        set_aside: where such a file went, else None.

    Raises:
        RunFailed: the file cannot be read or written.
    """

    def __init__(self, path: Path, what: Mapping[str, Any], beside: str | None = None) -> None:
        self.path = path
        self.set_aside: Path | None = None
        self._beside = beside
        self._header = {"format": FORMAT, "evaluation": json.loads(json.dumps(what))}
        self._done: dict[EpisodeKey, dict[str, Any]] = {}
        self._errors: dict[EpisodeKey, dict[str, Any]] = {}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.exists():
                self._read()
            if not path.exists():
                self._write(self._header)
            self.look_beside()
        except OSError as error:
            raise RunFailed(f"episodes cannot be kept: {error}", where=str(path)) from error

    def __contains__(self, key: EpisodeKey) -> bool:
        return key in self._done

    def add(self, record: Mapping[str, Any]) -> None:
        """Append a record; when this returns it survives a crash of the machine.

        Args:
            record: JSON values with ``group``, ``task``, ``seed`` and ``status``. Only records
                whose status is ``done`` count as finished; an error is tried again next time.

        Raises:
            RunFailed: the disk is full, or the file was taken away.
        """
        try:
            self._write(record)
        except OSError as error:
            raise RunFailed(
                f"an episode's result cannot be kept: {error}",
                where=str(self.path),
                next="make room and run the same command again; finished episodes are kept",
            ) from error
        self._keep(record)

    def records(self, keys: Iterable[EpisodeKey]) -> list[dict[str, Any]]:
        """Finished records among ``keys``, in the order of ``keys``."""
        return [self._done[key] for key in keys if key in self._done]

    def settled(self, keys: Iterable[EpisodeKey]) -> list[dict[str, Any]] | None:
        """The record of every one of ``keys``, in their order, or None while one is missing.

        An error counts: whoever had the episode tried it as often as it may be tried.
        """
        records = [self._done.get(key, self._errors.get(key)) for key in keys]
        found = [record for record in records if record is not None]
        return found if len(found) == len(records) else None

    def look_beside(self) -> None:
        """Take in what others have written by now.

        Raises:
            OSError: a file cannot be read.
        """
        for path in sorted(self.path.parent.glob(self._beside)) if self._beside else []:
            if path == self.path:
                continue
            data = path.read_bytes()
            lines = data[: data.rfind(b"\n") + 1].decode("utf-8", "replace").splitlines()
            if lines and _parsed(lines[0]) == self._header:
                for line in lines[1:]:
                    record = _parsed(line)
                    if record is not None:
                        self._keep(record)

    def _read(self) -> None:
        data = self.path.read_bytes()
        # A crash can leave the last line cut short; it was never reported as finished.
        whole = data[: data.rfind(b"\n") + 1]
        lines = whole.decode("utf-8", "replace").splitlines()
        records = [_parsed(line) for line in lines]
        if not records or records[0] != self._header:
            self._move_aside(data)
            return
        if len(whole) < len(data):
            with self.path.open("r+b") as file:
                file.truncate(len(whole))
        for record in records[1:]:
            if record is not None:
                self._keep(record)

    def _move_aside(self, data: bytes) -> None:
        name = f"{self.path.stem}-{hashlib.sha256(data).hexdigest()[:8]}{self.path.suffix}"
        self.set_aside = self.path.with_name(name)
        self.path.replace(self.set_aside)

    def _keep(self, record: Mapping[str, Any]) -> None:
        key = EpisodeKey(record["group"], record["task"], record["seed"])
        if record.get("status") == DONE:
            self._done[key] = dict(record)
        else:
            self._errors[key] = dict(record)

    def _write(self, record: Mapping[str, Any]) -> None:
        with self.path.open("ab") as file:
            file.write(json.dumps(record).encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())


def _parsed(line: str) -> dict[str, Any] | None:
    try:
        value = json.loads(line)
    except ValueError:
        return None
    return value if isinstance(value, dict) else None
