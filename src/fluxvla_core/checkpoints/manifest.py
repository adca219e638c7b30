"""A checkpoint folder's name, and the list of its files with their sizes and SHA-256.

A folder without a readable manifest is not a checkpoint. The manifest carries a hash of itself, so
that a flipped bit in it is not taken for damage of the file that it describes.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fluxvla_core.bounds import Count
from fluxvla_core.errors import CheckpointError
from fluxvla_core.untrusted import parse_json, read_bytes

FOLDER = "checkpoints"
"""In a work dir, with all of its checkpoints."""
NAME = "manifest.json"
FORMAT = "fluxvla-checkpoint-1"
_BLOCK = 1 << 20
_LARGEST = 16 << 20  # bytes: 100,000 files; 1,000 ranks write fewer than 3,000
_CHANGED = "it was changed, or the disk lost a part of it, after it was saved"
_STEP = re.compile(r"step-(\d{9,})")


def step_name(step: int) -> str:
    """Folder name of a step's checkpoint; sorts by step."""
    return f"step-{step:09d}"


def step_of(path: Path) -> int | None:
    """The step in a checkpoint folder's name; None for any other name."""
    match = _STEP.fullmatch(path.name)
    return int(match[1]) if match else None


@dataclass(frozen=True)
class FileEntry:
    """One file: bytes and SHA-256 in hexadecimal."""

    size: Count
    sha256: str


@dataclass(frozen=True)
class Manifest:
    """``files`` maps a path relative to the checkpoint (``/`` between parts) to its entry."""

    step: int
    epoch: int
    files: Mapping[str, FileEntry]

    def to_bytes(self) -> bytes:
        """JSON with a SHA-256 of the rest of it under ``sha256``."""
        body: dict[str, Any] = {
            "format": FORMAT,
            "step": self.step,
            "epoch": self.epoch,
            "files": {
                name: {"size": entry.size, "sha256": entry.sha256}
                for name, entry in sorted(self.files.items())
            },
        }
        body["sha256"] = _digest(body)
        return (json.dumps(body, indent=1) + "\n").encode()


@dataclass(frozen=True)
class _Body:
    format: str
    sha256: str
    step: Count
    epoch: Count
    files: dict[str, FileEntry]


def read_manifest(folder: Path) -> Manifest:
    """The manifest of the checkpoint in ``folder``.

    Raises:
        CheckpointError: it is missing, damaged, of another format version, or names a file outside
            the folder.
    """
    path = folder / NAME
    if not os.path.lexists(path):
        raise CheckpointError(
            f"{NAME} is missing, so this is not a checkpoint",
            where=str(folder),
            next="name a checkpoint, or the work dir of a training that has saved one",
        )
    try:
        content = read_bytes(path, CheckpointError, at_most=_LARGEST)
    except CheckpointError as error:
        raise CheckpointError(f"{NAME} {error.what}", where=str(folder)) from error
    try:
        raw = parse_json(content, dict[str, Any], CheckpointError, str(path))
    except CheckpointError as error:
        raise _damaged(folder, error.what) from error
    written = raw.get("format")
    if isinstance(written, str) and written != FORMAT:
        raise CheckpointError(
            f"the checkpoint has format {written[:80]!r}; this version reads {FORMAT!r}",
            where=str(path),
            cause="it was written by another version of FluxVLA",
            next="pip install --upgrade fluxvla-core",
        )
    try:
        body = parse_json(content, _Body, CheckpointError, str(path))
    except CheckpointError as error:
        raise _damaged(folder, error.what) from error
    if raw.pop("sha256") != _digest(raw):
        raise _damaged(folder, "its own SHA-256 does not fit")
    _check_inside(folder, body.files)
    return Manifest(body.step, body.epoch, body.files)


def _damaged(folder: Path, how: str) -> CheckpointError:
    return CheckpointError(f"{NAME} is damaged: {how}", where=str(folder), cause=_CHANGED)


def _check_inside(folder: Path, names: Iterable[str]) -> None:
    """Refuse files that do not lie in ``folder``: a checkpoint would read, or copy, any other."""
    root = os.path.realpath(folder)
    for name in names:
        parts = name.split("/")
        if {"", ".", ".."} & set(parts) or "\0" in name or "\\" in name:
            why = "is not a path inside the checkpoint's folder"
        elif os.path.commonpath([root, os.path.realpath(os.path.join(root, *parts))]) != root:
            why = "leads out of the checkpoint's folder by a symbolic link"
        else:
            continue
        raise CheckpointError(
            f"{NAME} lists {name[:200]!r}, which {why}",
            where=str(folder),
            cause="the checkpoint was put together by hand, or is meant to do harm",
            next="copy it with its links replaced by the files (cp -rL, rsync -L)",
        )


def hash_file(path: Path) -> str:
    """SHA-256 of a file's bytes, read in blocks."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def _digest(body: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()
