"""Write files atomically, and check that a folder can be written to."""

from __future__ import annotations

import errno
import json
import math
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fluxvla_core.errors import UsageError

FULL = {errno.ENOSPC, errno.EFBIG, errno.EDQUOT}
"""``errno`` of an OSError where the disk, a quota or a limit on file sizes is exhausted."""


def prepare_folder(path: Path, what: str, next: str) -> None:
    """Create the folder and try to write to it, before any work is done for it.

    Args:
        what: the folder's purpose, for the message.
        next: what to do instead, for the message.

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


def refuse_content(target: Path) -> None:
    """Refuse to create a folder over existing files.

    Raises:
        UsageError: there is something at ``target``.
    """
    if target.exists() and not (target.is_dir() and not any(target.iterdir())):
        raise UsageError(
            f"there is something at {target} already", next="name a folder that does not exist yet"
        )


_LINE = json.JSONEncoder(allow_nan=False)
"""Kept: creating an encoder takes a fifth of the time of encoding a short line."""


def json_text(value: Any, indent: int | None = None) -> str:
    """``value`` as JSON. NaN and infinities, which JSON does not have, become null."""
    encoder = _LINE if indent is None else json.JSONEncoder(indent=indent, allow_nan=False)
    try:
        return encoder.encode(value)
    except (TypeError, ValueError):
        # NaN, an infinity, or a mapping that is not a dict.
        return encoder.encode(_finite(value))


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(inner) for inner in value]
    return value


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text to a temporary file next to ``path``, in a folder that exists; rename it.

    A reader never sees half a file; a process that is killed leaves the old one.

    Raises:
        OSError: it cannot be written; no temporary file is left.
    """
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        aside.write_text(text, encoding="utf-8")
        os.replace(aside, path)
    finally:
        aside.unlink(missing_ok=True)


def write_json(path: Path, value: Any, indent: int = 1) -> None:
    """Write ``value`` as indented JSON, as :func:`write_text` writes text.

    Raises:
        OSError: it cannot be written.
    """
    write_text(path, json.dumps(value, indent=indent, ensure_ascii=False) + "\n")
