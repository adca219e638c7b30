"""Files that are there whole or not at all, and folders that can be written in."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from fluxvla_core.errors import UsageError


def prepare_folder(path: Path, what: str, next: str) -> None:
    """Make the folder and try to write in it, before any work is done for it.

    Args:
        what: goes there, for the message.
        next: the way on.

    Raises:
        UsageError: it cannot be made or written.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path) as file:
            file.write(b"x")
    except OSError as error:
        raise UsageError(
            f"cannot write to the {what}: {error.strerror or error}", where=str(path), next=next
        ) from error


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text beside ``path``, in a folder that exists, and rename it there.

    A reader never sees half a file, and whoever is killed leaves what was there before.

    Raises:
        OSError: it cannot be written; nothing is left beside it.
    """
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        aside.write_text(text, encoding="utf-8")
        os.replace(aside, path)
    finally:
        aside.unlink(missing_ok=True)
