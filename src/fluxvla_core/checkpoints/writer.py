"""Saving a checkpoint so that a kill at any moment leaves the ones before it as they were.

A checkpoint is written into a folder with another name, every file flushed to the device, the
manifest last; then the folder gets its final name in one rename. Readers only look at final names.
Several ranks may write files of one checkpoint; the first makes, completes and names the folder.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

from fluxvla_core.atomic import FULL
from fluxvla_core.checkpoints.manifest import FOLDER, FileEntry, Manifest, hash_file, step_name
from fluxvla_core.checkpoints.manifest import NAME as MANIFEST
from fluxvla_core.errors import RunFailed

_RESUME = "run the same command with --resume auto; the checkpoints before it are as they were"
T = TypeVar("T")

PARTIAL = ".partial"
"""End of the name of a folder that is being written."""


class CheckpointWriter:
    """Collects one checkpoint's files and makes them a checkpoint in :meth:`commit`.

    Use as a context manager: leaving it by an exception removes the folder. The first
    OSError is kept and everything after it skipped until ``commit`` raises it, because the other
    ranks take part in gathering tensors and must not be left waiting in the middle.

    Args:
        work_dir: the run's folder; the checkpoint goes to ``checkpoints/step-…`` in it.
        step, epoch: of the checkpoint, for its manifest.
        disk: the file operations.
        rank: only rank 0 makes, commits and removes the folder; what the others wrote reaches it
            by :meth:`rank_report` and :meth:`merge_reports`.
        final: another folder than that of the step.
        what, go_on: name of the written thing, and how to continue, for error messages; by
            default a training's checkpoint.
    """

    def __init__(
        self,
        work_dir: Path,
        step: int,
        epoch: int,
        disk: Disk | None = None,
        rank: int = 0,
        final: Path | None = None,
        what: str | None = None,
        go_on: str = _RESUME,
    ) -> None:
        self._what = what or f"the checkpoint of step {step}"
        self._go_on = go_on
        self.disk = disk or Disk()
        self.step, self.epoch, self.rank = step, epoch, rank
        self.final = final or work_dir / FOLDER / step_name(step)
        self.folder = self.final.with_name(self.final.name + PARTIAL)
        self.files: dict[str, FileEntry] = {}
        self._error: OSError | None = None

    def __enter__(self) -> CheckpointWriter:
        self.begin()
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if error is not None:
            self.discard()

    def begin(self, *folders: str) -> None:
        """Make the folder that all ranks write into, with ``folders`` in it; others do nothing."""
        if self.rank == 0:
            if self.folder.exists():
                self.attempt(self.disk.remove_folder, self.folder)
            self.attempt(self.disk.make_folder, self.folder, True)
            for name in folders:
                self.attempt(self.disk.make_folder, self.folder / name)

    def attempt(self, operation: Callable[..., T], *arguments: Any) -> T | None:
        """``operation(*arguments)``, or None if it or anything before it failed."""
        if self._error is None:
            try:
                return operation(*arguments)
            except OSError as error:
                self._error = error
        return None

    def set_error(self, error: Exception) -> None:
        """Make :meth:`commit` raise ``error``, unless an earlier error is set."""
        if self._error is None:
            described = OSError(f"{type(error).__name__}: {error}")
            self._error = error if isinstance(error, OSError) else described

    @contextmanager
    def open(self, name: str) -> Iterator[HashedFile]:
        """A new file ``name`` (``/`` between parts) to write bytes into."""
        file = HashedFile(self, name)
        try:
            yield file
        finally:
            file.close()

    def write_bytes(self, name: str, data: bytes) -> None:
        """A file with ``data`` in it."""
        with self.open(name) as file:
            file.write(data)

    def write_json(self, name: str, value: Mapping[str, Any]) -> None:
        """A file with ``value`` as JSON.

        Raises:
            RunFailed: something in ``value`` is not a JSON value.
        """
        self.write_bytes(name, json_bytes(name, value))

    def write_folder(self, name: str, save: Callable[[Path], Any]) -> None:
        """A folder that ``save`` fills by itself, as ``save_pretrained`` does.

        :meth:`add_folder` adds its files to the manifest.
        """
        self.attempt(self._write_folder, self.folder / name, save)

    def _write_folder(self, folder: Path, save: Callable[[Path], Any]) -> None:
        self.disk.make_folder(folder)
        save(folder)

    def add_folder(self, name: str) -> None:
        """Flush the files of :meth:`write_folder` to the device and add them to the manifest."""
        self.attempt(self._add_folder, self.folder / name)

    def _add_folder(self, folder: Path) -> None:
        for path in files_below(folder):
            self.disk.finish(path.open("rb+"))
            self.files[path.relative_to(self.folder).as_posix()] = FileEntry(
                path.stat().st_size, hash_file(path)
            )

    def rank_report(self) -> str:
        """This rank's files, or its error, for :meth:`merge_reports` on rank 0."""
        files = {name: [entry.size, entry.sha256] for name, entry in self.files.items()}
        error = self._error and [self._error.errno, self._error.strerror or str(self._error)]
        return json.dumps({"rank": self.rank, "files": files, "error": error})

    def merge_reports(self, reports: Iterable[str]) -> None:
        """Add the files and errors that other ranks report, on rank 0."""
        for report in map(json.loads, reports):
            if report["rank"] == self.rank:
                continue
            self.files |= {name: FileEntry(*entry) for name, entry in report["files"].items()}
            if report["error"] is not None and self._error is None:
                number, text = report["error"]
                text = f"{text}, on rank {report['rank']}"
                if number == errno.ENOENT:
                    text += ", which may not see the first rank's work dir"
                self._error = OSError(text) if number is None else OSError(number, text)

    def commit(self) -> Path:
        """Give the folder its final name and return it.

        Raises:
            RunFailed: a file could not be written; the half-written folder is removed and every
                earlier checkpoint is as it was.
        """
        self.write_bytes(MANIFEST, Manifest(self.step, self.epoch, self.files).to_bytes())
        self.attempt(self._put_in_place)
        if self._error is not None:
            self.discard()
            raise self._failure(self._error) from self._error
        return self.final

    def _failure(self, error: OSError) -> RunFailed:
        full = error.errno in FULL
        what = f"{self._what} could not be saved"
        return RunFailed(
            f"the disk is full: {what}" if full else f"{what}: {error}",
            where=str(self.final),
            cause=f"{error.strerror}, or a quota or a limit on file sizes" if full else None,
            next=f"{'make room' if full else 'fix the disk or the folder'}, then {self._go_on}",
        )

    def _put_in_place(self) -> None:
        for folder in sorted({(self.folder / name).parent for name in self.files}):
            self.disk.sync_folder(folder)
        self.disk.sync_folder(self.folder)
        if self.final.exists():
            self.disk.rename(self.final, free_name(self.final))
        self.disk.rename(self.folder, self.final)
        self.disk.sync_folder(self.final.parent)

    def discard(self) -> None:
        """Remove the folder."""
        # A partial folder that cannot be removed either does no harm: readers ignore its name,
        # and the next save of this step removes it.
        with contextlib.suppress(OSError):
            if self.rank == 0 and self.folder.exists():
                self.disk.remove_folder(self.folder)


class HashedFile:
    """One file of a checkpoint; its size and hash are known when it is closed."""

    def __init__(self, writer: CheckpointWriter, name: str) -> None:
        self._writer, self._name = writer, name
        self._digest, self._size = hashlib.sha256(), 0
        self._file: BinaryIO | None = writer.attempt(self._create, writer.folder / name)

    def _create(self, path: Path) -> BinaryIO:
        # Other ranks' folders are there, or are those of a disk that the first rank does not see.
        if self._writer.rank == 0:
            inside = path.relative_to(self._writer.folder).parents
            for folder in (self._writer.folder / name for name in reversed(inside[:-1])):
                if not folder.exists():
                    self._writer.disk.make_folder(folder)
        return self._writer.disk.create(path)

    def write(self, data: bytes | memoryview) -> None:
        """Append ``data``; nothing happens once the writer has failed."""
        self._writer.attempt(self._append, data)

    def _append(self, data: bytes | memoryview) -> None:
        if self._file is not None:
            self._writer.disk.write(self._file, data)
            self._digest.update(data)
            self._size += memoryview(data).nbytes

    def close(self) -> None:
        """Flush to the device and enter the file in the manifest."""
        if self._file is None:
            return
        self._writer.attempt(self._finish, self._file)
        if not self._file.closed:
            with contextlib.suppress(OSError):
                self._file.close()

    def _finish(self, file: BinaryIO) -> None:
        self._writer.disk.finish(file)
        if self._name != MANIFEST:
            self._writer.files[self._name] = FileEntry(self._size, self._digest.hexdigest())


def json_bytes(name: str, value: Mapping[str, Any]) -> bytes:
    """``value`` as JSON; floats keep every bit, NaN is refused.

    Raises:
        RunFailed: something in ``value`` is not a JSON value.
    """
    try:
        return (json.dumps(value, indent=1, allow_nan=False) + "\n").encode()
    except (TypeError, ValueError) as error:
        raise RunFailed(
            f"{name} of the checkpoint cannot be written as JSON: {error}",
            cause="the state of the scheduler or metric holds more than plain values",
        ) from error


class Disk:
    """Plain POSIX file operations; every one raises OSError as the system does."""

    def make_folder(self, path: Path, parents: bool = False) -> None:
        """By default in one that exists: a work dir that was removed is not made again."""
        path.mkdir(parents=parents)

    def create(self, path: Path) -> BinaryIO:
        return path.open("xb")

    def write(self, file: BinaryIO, data: bytes | memoryview) -> None:
        file.write(data)

    def finish(self, file: BinaryIO) -> None:
        """Flush to the device and close: after a crash the file is whole or not there."""
        try:
            file.flush()
            os.fsync(file.fileno())
        finally:
            file.close()

    def sync_folder(self, path: Path) -> None:
        """Make the names in ``path`` durable; a rename is only then certain to survive a crash."""
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def rename(self, source: Path, target: Path) -> None:
        os.rename(source, target)

    def remove_folder(self, path: Path) -> None:
        shutil.rmtree(path)


def files_below(folder: Path) -> Iterator[Path]:
    """Every regular file below ``folder``, in a fixed order."""
    yield from sorted(p for p in folder.rglob("*") if p.is_file())


def free_name(path: Path) -> Path:
    """A free name next to ``path`` that no reader takes for a checkpoint."""
    number, free = 1, path.with_name(path.name + ".set-aside")
    while free.exists():
        number += 1
        free = path.with_name(f"{path.name}.set-aside-{number}")
    return free
