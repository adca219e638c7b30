"""Read and write files of a dataset: parquet, JSON, staging folders; optional packages.

A dataset is written into a staging folder next to it, ``.<name>.writing``, and renamed when it is
complete. Errors name the file.
"""

from __future__ import annotations

import importlib
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from fluxvla_core import atomic, untrusted
from fluxvla_core.errors import ConfigError, DataError, RunFailed

T = TypeVar("T")
_MOST_ROWS = 1 << 30  # a year of frames at 30 Hz


def libav() -> Any:
    """The package PyAV.

    Raises:
        ConfigError: with the command that installs it; so do the functions below.
    """
    return _load("av")


def reformatter() -> Any:
    """A new converter of pixel formats; it keeps its tables between frames."""
    return _load("av.video.reformatter").VideoReformatter()


def opencv() -> Any:
    """The package OpenCV."""
    return _load("cv2")


def open_video(path: Path) -> Any:
    """Open an mp4 for reading, with PyAV.

    The format is given: by a file's content ffmpeg would also take a playlist, and open the files
    that it names. Tags need not be UTF-8.

    Raises:
        av.error.FFmpegError: it cannot be opened.
    """
    return libav().open(str(path), format="mp4", metadata_errors="replace")


def arrow() -> Any:
    """The package pyarrow."""
    return _load("pyarrow")


def parquet() -> Any:
    """The package pyarrow.parquet."""
    return _load("pyarrow.parquet")


def _load(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise ConfigError(
            f"datasets need the package {package}, which cannot be imported: {error}",
            next="pip install 'fluxvla-core[data]'",
        ) from error


def read_table(path: Path, columns: Sequence[str] | None = None, rows: int | None = None) -> Any:
    """Read a parquet file as a pyarrow table.

    Args:
        rows: how many it must have; checked before any are read, as a file of a few bytes can
            unpack to any number.

    Raises:
        DataError: it is missing, damaged, lacks a column, or has other rows, or too many.
    """
    pa = arrow()
    pq = parquet()

    if not os.path.isfile(path):
        raise DataError(f"{path}: the file is missing")
    try:
        with pq.ParquetFile(path) as file:
            lacking = sorted(set(columns or ()) - set(file.schema_arrow.names))
            if lacking:
                raise DataError(f"{path}: column {', '.join(map(repr, lacking))} is missing")
            found = file.metadata.num_rows
            if rows is not None and found != rows:
                raise DataError(f"{path}: {rows} frames expected, {found} found")
            if found > _MOST_ROWS:
                raise DataError(f"{path}: {found} rows, {_MOST_ROWS} are the most that are read")
            return file.read(columns=list(columns) if columns else None, use_threads=False)
    # ValueError: text that is not UTF-8 in a damaged schema.
    except (pa.ArrowException, OSError, ValueError) as error:
        raise DataError(
            f"{path}: cannot be read as parquet ({first_line(error)})",
            cause="the file is truncated, or its writer was stopped before its end",
            next="copy the file again from where it came from",
        ) from error


def first_line(error: Exception) -> str:
    """The first line of a library's error message."""
    return next(iter(str(error).splitlines()), type(error).__name__)[:300]


def whole_numbers(table: Any, name: str, where: str) -> npt.NDArray[np.int64]:
    """Check a column of counts and return it as an array ``(N,)``.

    Raises:
        DataError: it holds other than whole numbers from 0 to 2^53, or gaps.
    """
    column = table[name].combine_chunks()
    if arrow().types.is_integer(column.type) and (array := _bounded(column)) is not None:
        return array.astype(np.int64)
    raise DataError(f"{where}: column {name!r} must hold whole numbers from 0 on, no gaps")


def seconds(table: Any, name: str, where: str) -> npt.NDArray[np.float64]:
    """Check a column of times and return it as an array ``(N,)``.

    Raises:
        DataError: it holds other than finite numbers from 0 on, or gaps.
    """
    column, types = table[name].combine_chunks(), arrow().types
    number = types.is_floating(column.type) or types.is_integer(column.type)
    if number and (array := _bounded(column)) is not None:
        return array.astype(np.float64)
    raise DataError(f"{where}: column {name!r} must hold seconds from 0 on, no gaps")


def _bounded(column: Any) -> npt.NDArray[Any] | None:
    """A column of numbers without gaps, from 0 to 2^53; None for any other."""
    if column.null_count:
        return None
    array: npt.NDArray[Any] = column.to_numpy(zero_copy_only=False)
    return array if ((array >= 0) & (array < 1 << 53)).all() else None


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object. Raises DataError if it cannot be read."""
    return untrusted.read_json(path, dict[str, Any], DataError)


def read_json_lines(path: Path, kind: type[T]) -> list[T]:
    """Read a JSON lines file, one ``kind`` a line. Raises DataError for a line that is not one."""
    if not os.path.isfile(path):
        raise DataError(f"{path}: the file is missing")
    lines = untrusted.read_bytes(path, DataError).splitlines()
    return [
        untrusted.parse_json(line, kind, DataError, f"{path}:{number}")
        for number, line in enumerate(lines, 1)
        if line.strip()
    ]


def write_metadata(path: Path, value: Any) -> None:
    """Write a JSON file of a dataset, indented as LeRobot's are; its folder is made if need be.

    Atomically: a kill leaves what was there before.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic.write_json(path, value, indent=4)


def staging_of(root: Path) -> Path:
    """The staging folder: where the dataset ``root`` is while it is written."""
    return root.with_name(f".{root.name}.writing")


def make_staging(staging: Path) -> None:
    """Make the staging folder.

    Raises:
        DataError: it cannot be made.
    """
    try:
        staging.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(
            f"{staging.parent}: no dataset can be written here ({error.strerror})",
            cause="there is no permission to write, or a file is where a folder should be",
        ) from error


@contextmanager
def staging_folder(target: Path, safe: str, next: str) -> Iterator[Path]:
    """A staging folder to write the dataset ``target`` into; published if nothing is raised.

    Args:
        safe, next: what to say when the disk is full.

    Raises:
        DataError: ``target`` exists, is being written, or cannot be written.
        RunFailed: the disk is full.
    """
    check_absent(target)
    staging = staging_of(target)
    if staging.exists():
        raise DataError(
            f"{target}: {staging} is in the way",
            cause="another process writes the same dataset, or was interrupted",
            next="delete that folder if nothing is writing there",
        )
    make_staging(staging)
    try:
        yield staging
        publish(staging, target)
    except OSError as error:
        raise explain_disk(error, target, safe, next) from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def explain_disk(error: OSError, root: Path, safe: str, next: str) -> Exception:
    """The exception to raise for ``error``: RunFailed when the disk is full, else ``error``."""
    if error.errno not in atomic.FULL:
        return error
    return RunFailed(f"{root}: no space left on the disk", cause=safe, next=next)


def check_absent(root: Path) -> None:
    """Refuse to overwrite anything.

    Raises:
        DataError: ``root`` exists and is not an empty folder.
    """
    if root.exists() and (not root.is_dir() or any(root.iterdir())):
        raise DataError(
            f"{root}: there is something here already; a dataset is never written over",
            next="choose another folder, or delete this one",
        )


def publish(built: Path, root: Path) -> None:
    """Move a finished dataset to its place in one step, its files synced to the disk first."""
    for path in sorted(built.rglob("*")):
        if path.is_file():
            with path.open("rb") as file:
                os.fsync(file.fileno())
    os.replace(built, root)
    parent = os.open(root.parent, os.O_RDONLY)
    try:
        os.fsync(parent)
    finally:
        os.close(parent)
