"""Reading what a run left behind, whole or cut short, without ever failing on it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any


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
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return {}
        except (OSError, ValueError) as error:
            self.problem(path, f"cannot be read: {error}")
            return {}
        if not isinstance(content, dict):
            self.problem(path, f"holds a {type(content).__name__}, not an object")
            return {}
        return content

    def lines(self, path: Path) -> list[dict[str, Any]]:
        """The JSON objects of a file with one a line; a last line cut short is left out.

        A process that was killed leaves such a line; anywhere else it is noted as a problem.
        """
        try:
            text = path.read_text(encoding="utf-8")
        except FileNotFoundError:
            return []
        except (OSError, ValueError) as error:
            self.problem(path, f"cannot be read: {error}")
            return []
        rows: list[dict[str, Any]] = []
        bad = 0
        for line in text.splitlines(keepends=True):
            try:
                row = json.loads(line)
            except ValueError:
                bad += line.endswith("\n")
                continue
            if isinstance(row, dict):
                rows.append(row)
            else:
                bad += 1
        if bad:
            self.problem(path, f"{bad} line(s) are no JSON objects and were left out")
        return rows


def number(value: Any) -> float:
    """``value`` as a float; NaN for what is no number."""
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
