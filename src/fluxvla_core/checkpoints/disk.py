"""The file operations that a checkpoint is made of, in one place so that each can be made to fail.

Tests hand a writer a ``Disk`` that stops at the n-th operation: what a kill, a full disk or a
lost mount leaves behind is then checked for every n.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO


class Disk:
    """Plain POSIX file operations; every one raises OSError as the system does."""

    def make_folder(self, path: Path) -> None:
        path.mkdir(parents=True)

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


def aside(path: Path) -> Path:
    """A free name beside ``path`` that no reader takes for a checkpoint."""
    number, free = 1, path.with_name(path.name + ".set-aside")
    while free.exists():
        number += 1
        free = path.with_name(f"{path.name}.set-aside-{number}")
    return free
