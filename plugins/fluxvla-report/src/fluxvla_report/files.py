"""Reading what a run left behind, whole or cut short, without ever failing on it."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from fluxvla_core.errors import DataError
from fluxvla_core.results import parse_json, read_bytes, read_json

_LARGEST_LOG = 1 << 30  # bytes: ten million records of a training


class Reader:
    """Reads JSON files of a work dir; what cannot be read is noted in ``problems``.

    Args:
        root: problems name paths as seen from here.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.problems: list[str] = []

    def problem(self, path: Path, what: str) -> None:
        """Note what is wrong with a file."""
        shown = path.relative_to(self.root) if path.is_relative_to(self.root) else path
        self.problems.append(f"{shown}: {what}")

    def mapping(self, path: Path) -> dict[str, Any]:
        """The JSON object in a file; empty when there is no file, or no object in it."""
        if not os.path.lexists(path):
            return {}
        try:
            return read_json(path, dict[str, Any], DataError)
        except DataError as error:
            self.problem(path, error.what)
            return {}

    def lines(self, path: Path) -> list[dict[str, Any]]:
        """The JSON objects of a file with one a line; a last line cut short is left out.

        A process that was killed leaves such a line; anywhere else it is noted as a problem.
        """
        if not os.path.lexists(path):
            return []
        try:
            text = read_bytes(path, DataError, at_most=_LARGEST_LOG)
        except DataError as error:
            self.problem(path, error.what)
            return []
        rows: list[dict[str, Any]] = []
        bad = 0
        for line in text.splitlines(keepends=True):
            try:
                rows.append(parse_json(line, dict[str, Any], DataError, str(path)))
            except DataError:
                bad += line.endswith(b"\n")
        if bad:
            self.problem(path, f"{bad} line(s) are not JSON objects and were left out")
        return rows


def number(value: Any) -> float:
    """``value`` as a float; NaN for what is not a number."""
    return float(value) if isinstance(value, (int, float)) else float("nan")


def mappings(value: Any) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """The entries of ``value`` that are objects, when it is an object itself."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            if isinstance(inner, Mapping):
                yield str(key), inner


def text_rows(pairs: Iterable[tuple[str, Any]]) -> list[tuple[str, str]]:
    """Name and text of those pairs that have a value worth a row."""
    return [(name, str(value)) for name, value in pairs if value not in (None, "", [], {}, ())]
