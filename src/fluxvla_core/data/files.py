"""Files of a dataset, read so that what is wrong with one is said by its name."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fluxvla_core import atomic
from fluxvla_core.data.optional import arrow, parquet
from fluxvla_core.errors import DataError


def read_table(path: Path, columns: Sequence[str] | None = None) -> Any:
    """A parquet file as a pyarrow table.

    Raises:
        DataError: it is missing, damaged, or lacks a column.
    """
    pa = arrow()
    pq = parquet()

    if not path.is_file():
        raise DataError(f"{path}: the file is missing")
    try:
        with pq.ParquetFile(path) as file:
            lacking = sorted(set(columns or ()) - set(file.schema_arrow.names))
            if lacking:
                raise DataError(f"{path}: column {', '.join(map(repr, lacking))} is missing")
            return file.read(columns=list(columns) if columns else None, use_threads=False)
    except (pa.ArrowException, OSError) as error:
        raise DataError(
            f"{path}: cannot be read as parquet ({str(error).splitlines()[0]})",
            cause="the file is truncated, or its writer was stopped before its end",
            next="copy the file again from where it came from",
        ) from error


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object. Raises DataError if it cannot be read."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: cannot be read as JSON ({error})") from error
    if not isinstance(found, dict):
        raise DataError(f"{path}: holds a {type(found).__name__}, not a table")
    return found


def read_json_lines(path: Path) -> list[dict[str, Any]]:
    """JSON objects, one a line. Raises DataError if the file or a line cannot be read."""
    if not path.is_file():
        raise DataError(f"{path}: the file is missing")
    found: list[dict[str, Any]] = []
    try:
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            if line.strip():
                value = json.loads(line)
                if not isinstance(value, dict):
                    raise DataError(f"{path}:{number}: holds a {type(value).__name__}, no table")
                found.append(value)
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: cannot be read as JSON lines ({error})") from error
    return found


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` as JSON that people can read, in one step: a kill leaves what was before."""
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic.write_text(path, json.dumps(value, indent=4, ensure_ascii=False) + "\n")
