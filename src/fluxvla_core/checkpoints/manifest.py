"""The list of a checkpoint's files with their sizes and SHA-256 sums, which makes it a whole.

A folder without a readable manifest is no checkpoint. The manifest carries a sum of itself, so
that a flipped bit in it is not taken for damage of the file that it describes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fluxvla_core.errors import CheckpointError

NAME = "manifest.json"
FORMAT = "fluxvla-checkpoint-1"
_BLOCK = 1 << 20


@dataclass(frozen=True)
class FileEntry:
    """One file: bytes and SHA-256 in hexadecimal."""

    size: int
    sha256: str


@dataclass(frozen=True)
class Manifest:
    """``files`` maps a path relative to the checkpoint (``/`` between parts) to its entry."""

    step: int
    epoch: int
    files: Mapping[str, FileEntry]

    def to_bytes(self) -> bytes:
        """JSON with a sum of the rest of it under ``sha256``."""
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


def read_manifest(folder: Path) -> Manifest:
    """The manifest of the checkpoint in ``folder``.

    Raises:
        CheckpointError: it is missing, damaged, or of another format version.
    """
    path = folder / NAME
    try:
        body = json.loads(path.read_bytes())
        stated = body.pop("sha256")
        if body.get("format") != FORMAT:
            raise CheckpointError(
                f"the checkpoint has format {body.get('format')!r}; this version reads {FORMAT!r}",
                where=str(path),
                cause="it was written by another version of FluxVLA",
            )
        if stated != _digest(body):
            raise ValueError("its own SHA-256 does not fit")
        files = {name: FileEntry(int(e["size"]), e["sha256"]) for name, e in body["files"].items()}
        return Manifest(int(body["step"]), int(body["epoch"]), files)
    except FileNotFoundError:
        raise CheckpointError(
            f"{NAME} is missing, so this is no checkpoint", where=str(folder)
        ) from None
    except OSError as error:
        raise CheckpointError(f"{NAME} cannot be read: {error}", where=str(folder)) from error
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"{NAME} is damaged: {error}",
            where=str(folder),
            cause="it was changed, or the disk lost a part of it, after it was saved",
        ) from error


def hash_file(path: Path) -> str:
    """SHA-256 of a file's bytes, read in blocks."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def _digest(body: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()
