"""Episodes of an evaluation: their keys, their shards, and the log of those that are finished.

The evaluation log (``EvalLog``, ``episodes.jsonl``) has one JSON object a line, on disk as soon as
an episode has ended. Its first line, the header, says what was evaluated and which code ran it.
Starting the same evaluation again continues where it ended, however it ended; another evaluation
never counts what it finds there. Episodes of other code are counted only with ``reuse``; another
header then stands before those that follow.

An evaluation may be split into shards, one a process. torchrun sets ``RANK`` and ``WORLD_SIZE``, a
SLURM array ``SLURM_ARRAY_TASK_ID`` (with ``_MIN``, ``_COUNT``), ``srun`` ``SLURM_PROCID`` and
``SLURM_NTASKS``; an array of srun steps has both. No process waits for another: each shard has an
evaluation log of its own in the same folder, and whichever finds all episodes finished writes the
results.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from fluxvla_core.atomic import json_text
from fluxvla_core.contracts.runner import Reporter
from fluxvla_core.errors import RunFailed, UsageError
from fluxvla_core.untrusted import read_bytes

T = TypeVar("T")
DONE, ERROR = "done", "error"
"""Status of a record."""
POLICY, SWAPPED, UNTRAINED = "policy", "swapped", "untrained"
"""Groups: the policy, the policy with another task's instruction, its untrained baseline."""
FORMAT = "fluxvla-episodes-2"
FORMER = "fluxvla-episodes-1"
"""Without the code."""
_FORMER_KEYS = {"skipped_beats": "skipped_ticks", "pictures": "images"}
"""Keys of records of version 0.1, under which they are still read."""
LARGEST_LOG = 1 << 30
"""Bytes of an evaluation log, of some 500 an episode."""


@dataclass(frozen=True, order=True)
class EpisodeKey:
    """Identifies an episode within one evaluation; its outcome follows from it.

    Args:
        group: which policy, with which instruction: ``policy``, ``swapped``, ``untrained``, …
        task: the task whose scene and success are meant.
        seed: seed of everything random in the episode.
    """

    group: str
    task: str
    seed: int


def episode_keys(
    groups: Sequence[tuple[str, int]], tasks: Sequence[str], episodes: int, together: bool
) -> list[EpisodeKey]:
    """Every episode of an evaluation, in the order in which they are given out.

    Args:
        groups: name and first seed of each; those of one number are side by side.
        episodes: for each task and group.
        together: task by task; otherwise in turn, so that progress shows all tasks from the start.
    """
    numbers = range(episodes)
    pairs = [(task, number) for number in numbers for task in tasks]
    if together:
        pairs = [(task, number) for task in tasks for number in numbers]
    return [
        EpisodeKey(group, task, first + number) for task, number in pairs for group, first in groups
    ]


def reason(text: str) -> str:
    """One line of an error message or a traceback: the last that is not advice."""
    lines = text.strip().splitlines()
    said = [line for line in lines if not line.startswith(("  likely cause: ", "  next: "))]
    return (said or lines)[-1].strip()


@dataclass(frozen=True)
class Shard:
    """Part ``index`` of ``count`` of an evaluation's episodes; all of them by default."""

    index: int = 0
    count: int = 1

    def of(self, items: Sequence[T]) -> list[T]:
        """Every ``count``-th item: each part has some of every task."""
        return list(items[self.index :: self.count])

    @property
    def log_name(self) -> str:
        """The file name of this part's evaluation log."""
        if self.count == 1:
            return "episodes.jsonl"
        return f"episodes-{self.index:04d}-of-{self.count:04d}.jsonl"


def shard_of(environment: Mapping[str, str] | None = None) -> Shard:
    """The shard of this process, from its environment variables.

    Raises:
        UsageError: they contradict each other.
    """
    env = os.environ if environment is None else environment
    try:
        array = _array(env)
        step = _pair(env, "RANK", "WORLD_SIZE") or _pair(env, "SLURM_PROCID", "SLURM_NTASKS")
    except ValueError as error:
        raise UsageError(f"this process cannot tell which part of the job it is: {error}") from None
    (a, n), (b, m) = array or (0, 1), step or (0, 1)
    if not (0 <= a < n and 0 <= b < m):
        raise UsageError(
            f"this process is said to be part {a} of {n} and {b} of {m}",
            cause="RANK, WORLD_SIZE or SLURM_* were changed by hand",
        )
    return Shard(a * m + b, n * m)


def _array(env: Mapping[str, str]) -> tuple[int, int] | None:
    if "SLURM_ARRAY_TASK_ID" not in env:
        return None
    if int(env.get("SLURM_ARRAY_TASK_STEP", "1")) != 1:
        raise ValueError("the SLURM array counts in steps; use --array=0-N")
    first = int(env.get("SLURM_ARRAY_TASK_MIN", "0"))
    return int(env["SLURM_ARRAY_TASK_ID"]) - first, int(env["SLURM_ARRAY_TASK_COUNT"])


def _pair(env: Mapping[str, str], index: str, count: str) -> tuple[int, int] | None:
    if index not in env or count not in env:
        return None
    return int(env[index]), int(env[count])


class EvalLog:
    """Finished episodes in ``path``.

    Args:
        path: the file; its folder is made if need be.
        identity: what is evaluated, as JSON values. A file about another evaluation is
            set aside under a name of its own.
        other_logs: pattern of file names in the same folder in which other processes keep episodes
            of the same evaluation; what they have finished is finished here, too.
        code: what runs the episodes, as JSON values; not recorded and not compared by default.
        reuse: count episodes of other code, too.

    Attributes:
        set_aside: where such a file went, else None.
        reused: the episodes of other code that are counted.
        changed: what differs in that code, in words.

    Raises:
        UsageError: there are episodes of the same evaluation that other code ran, or the file
            cannot be read.
        RunFailed: it cannot be written.
    """

    def __init__(
        self,
        path: Path,
        identity: Mapping[str, Any],
        other_logs: str | None = None,
        code: Mapping[str, Any] | None = None,
        reuse: bool = False,
    ) -> None:
        self.path = path
        self.set_aside: Path | None = None
        self.reused: set[EpisodeKey] = set()
        self.changed: list[str] = []
        self._other_logs = other_logs
        self._reuse = reuse
        self._evaluation = json.loads(json_text(identity))
        self._code = None if code is None else json.loads(json_text(code))
        self._done: dict[EpisodeKey, dict[str, Any]] = {}
        self._errors: dict[EpisodeKey, dict[str, Any]] = {}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.exists():
                self._read()
            if not path.exists():
                self._write_header()
            self.read_other_logs()
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
        self.reused.discard(self._keep(record))

    def records(self, keys: Iterable[EpisodeKey]) -> list[dict[str, Any]]:
        """Finished records among ``keys``, in the order of ``keys``."""
        return [self._done[key] for key in keys if key in self._done]

    def settled(self, keys: Iterable[EpisodeKey]) -> list[dict[str, Any]] | None:
        """The record of every one of ``keys``, in their order, or None while one is missing.

        An error counts: the process that had the episode tried it as often as allowed.
        """
        records = [self._done.get(key, self._errors.get(key)) for key in keys]
        found = [record for record in records if record is not None]
        return found if len(found) == len(records) else None

    def read_other_logs(self) -> None:
        """Read what other processes have written by now.

        Raises:
            UsageError: a file cannot be read, or other code ran their episodes of this evaluation.
        """
        for path in sorted(self.path.parent.glob(self._other_logs)) if self._other_logs else []:
            if path == self.path:
                continue
            records = complete_lines(read_log(path))
            if records and self._is_mine(records[0]):
                self._take(records, path)

    def _read(self) -> None:
        data = read_log(self.path)
        # A crash can leave the last line cut short; it was never reported as finished.
        whole = data[: data.rfind(b"\n") + 1]
        records = complete_lines(whole)
        if not records or not self._is_mine(records[0]):
            self._move_aside(data)
            return
        if len(whole) < len(data):
            with self.path.open("r+b") as file:
                file.truncate(len(whole))
        if self._take(records, self.path) != self._code:
            self._write_header()

    def _is_mine(self, header: Mapping[str, Any]) -> bool:
        known = header.get("format") in (FORMAT, FORMER)
        return known and header.get("evaluation") == self._evaluation

    def _take(self, records: Sequence[Mapping[str, Any]], path: Path) -> Any:
        """Keep a file's episodes; the code of its last header."""
        code = None
        changes: dict[EpisodeKey, list[str]] = {}
        for record in records:
            if "format" in record:
                code = record.get("code")
                continue
            key = self._keep(record)
            if self._code is None or code == self._code:
                self.reused.discard(key)
                continue
            self.reused.add(key)
            changes[key] = code_differences(code, self._code)
        # Those that this code ran again later in the file are no longer another's.
        for key in changes.keys() & self.reused:
            self.changed += [line for line in changes[key] if line not in self.changed]
        if self.reused and not self._reuse:
            raise UsageError(
                "there are episodes of this evaluation that were run with other code: "
                f"{'; '.join(self.changed)}",
                where=str(path),
                cause="a library, a plugin or FluxVLA itself was changed since",
                next="another --work-dir, or delete the file, to run all of them again; "
                "--set <section>.reuse=true to count them together with the new ones",
            )
        return code

    def _write_header(self) -> None:
        self._write({"format": FORMAT, "evaluation": self._evaluation, "code": self._code})

    def _move_aside(self, data: bytes) -> None:
        name = f"{self.path.stem}-{hashlib.sha256(data).hexdigest()[:8]}{self.path.suffix}"
        self.set_aside = self.path.with_name(name)
        self.path.replace(self.set_aside)

    def _keep(self, record: Mapping[str, Any]) -> EpisodeKey:
        key = EpisodeKey(record["group"], record["task"], record["seed"])
        if record.get("status") == DONE:
            self._done[key] = dict(record)
        else:
            self._errors[key] = dict(record)
        return key

    def _write(self, record: Mapping[str, Any]) -> None:
        with self.path.open("ab") as file:
            file.write(json_text(record).encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())


def open_eval_log(
    path: Path,
    identity: Mapping[str, Any],
    reporter: Reporter,
    other_logs: str | None = None,
    code: Mapping[str, Any] | None = None,
    reuse: bool = False,
) -> EvalLog:
    """Open the log of an evaluation; reports if that of another evaluation was set aside,
    or if episodes of other code are counted."""
    log = EvalLog(path, identity, other_logs, code, reuse)
    if log.reused:
        reporter.warn(
            f"{len(log.reused)} episodes that other code ran are counted, as reuse says: "
            f"{'; '.join(log.changed)}"
        )
    if log.set_aside is not None:
        reporter.info(f"{path.name} was about another evaluation; it is {log.set_aside.name} now")
    return log


def read_log(path: Path) -> bytes:
    """The content of an evaluation log.

    Raises:
        UsageError: it cannot be read, or is no regular file.
    """
    return read_bytes(path, UsageError, at_most=LARGEST_LOG)


def complete_lines(data: bytes) -> list[dict[str, Any]]:
    """Headers and episodes of a log; a header, or an empty one, comes first. What is neither is
    left out, as is a last line that was cut short: those episodes were not finished."""
    whole = data[: data.rfind(b"\n") + 1].decode("utf-8", "replace")
    lines = [_parsed(line) for line in whole.splitlines()]
    return [line for line in [(lines[0] or {}) if lines else None, *lines[1:]] if line is not None]


def _parsed(line: str) -> dict[str, Any] | None:
    try:
        value = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(value, dict) or not ("format" in value or _is_episode(value)):
        return None
    return {_FORMER_KEYS.get(str(key), str(key)): entry for key, entry in value.items()}


def _is_episode(record: Mapping[str, Any]) -> bool:
    names = all(isinstance(record.get(name), str) for name in ("group", "task", "status"))
    outcome = record.get("status") != DONE or isinstance(record.get("success"), bool)
    return names and outcome and type(record.get("seed")) is int


def code_differences(before: Mapping[str, Any] | None, now: Mapping[str, Any]) -> list[str]:
    """Differences of ``now``, in words; both as ``provenance.Code.to_dict`` gives them."""
    if not isinstance(before, Mapping) or not isinstance(before.get("versions"), Mapping):
        return ["the code is not known: a former version of FluxVLA kept these episodes"]
    old, new = before["versions"], now["versions"]
    lines = [
        f"{name} {old.get(name, 'not there')} -> {new.get(name, 'not there')}"
        for name in sorted({*old, *new})
        if old.get(name) != new.get(name)
    ]
    if before.get("hash") != now["hash"]:
        lines.append(f"source code {before.get('hash')} -> {now['hash']}")
    return lines
