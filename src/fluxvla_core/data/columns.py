"""Columns of parquet files as numpy arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.data.episodes import FileId
from fluxvla_core.data.files import read_table
from fluxvla_core.data.metadata import Metadata
from fluxvla_core.data.optional import arrow
from fluxvla_core.errors import DataError

Array = npt.NDArray[Any]


def read_columns(meta: Metadata, vectors: Sequence[str]) -> dict[str, Array]:
    """All rows of the dataset, each column one array in the order of its rows.

    ``vectors`` come as ``(N, D)`` float32; ``timestamp`` ``(N,)`` float32, ``episode_index`` and
    ``task_index`` ``(N,)`` int64 are always there.

    Raises:
        DataError: a file is damaged or has other rows than the metadata says; a column has
            another type or width than ``info.json`` says, or holds nulls or no finite numbers.
    """
    widths = {name: meta.vector(name) for name in dict.fromkeys(vectors)}
    scalars = ("timestamp", "episode_index", "task_index")
    names = [*widths, *scalars]
    parts: dict[str, list[Array]] = {name: [] for name in names}
    rows: dict[FileId, int] = {}
    for length, file in zip(meta.episodes.lengths, meta.episodes.files, strict=True):
        rows[file] = rows.get(file, 0) + int(length)
    for file, expected in sorted(rows.items()):
        path = meta.data_file(file)
        table = read_table(path, names)
        if table.num_rows != expected:
            raise DataError(f"{path}: {expected} frames expected, {table.num_rows} found")
        for name in names:
            column = table[name].combine_chunks()
            where = f"{path}: column {name!r}"
            width = widths.get(name)
            array = _scalars(column, where) if width is None else _vectors(column, width, where)
            parts[name].append(array)
    columns = {name: np.concatenate(arrays) for name, arrays in parts.items()}
    _check_rows(meta, columns["episode_index"])
    return columns


def _check_rows(meta: Metadata, episode_of_row: Array) -> None:
    episodes = meta.episodes
    expected = np.repeat(np.arange(len(episodes)), episodes.lengths)
    inside = np.array_equal(episodes.first_row, np.append(0, episodes.end_row[:-1]))
    if not inside or not np.array_equal(episode_of_row, expected):
        raise DataError(
            f"{meta.root}: the rows of the data files are not those that the episode table lists",
            cause="files of two recordings were mixed, or the episode table was edited",
        )


def _scalars(column: Any, where: str) -> Array:
    pa = arrow()

    if pa.types.is_fixed_size_list(column.type) or pa.types.is_list(column.type):
        return _vectors(column, 1, where)[:, 0]
    _no_nulls(column, where)
    array: Array = column.to_numpy(zero_copy_only=False)
    return array


def _vectors(column: Any, width: int, where: str) -> Array:
    pa = arrow()

    _no_nulls(column, where)
    if not (pa.types.is_fixed_size_list(column.type) or pa.types.is_list(column.type)):
        if width != 1:
            raise DataError(f"{where} is {column.type}, not a list of {width} numbers")
        flat = column
    else:
        flat = column.flatten()
    rows = len(column)
    if len(flat) != rows * width or not all_of(column, width):
        raise DataError(
            f"{where} does not hold {width} numbers in every row, as info.json says; "
            f"it is {column.type}"
        )
    if not (pa.types.is_floating(flat.type) or pa.types.is_integer(flat.type)):
        raise DataError(f"{where} holds {flat.type}, not numbers")
    _no_nulls(flat, where)
    array: Array = flat.to_numpy(zero_copy_only=False).reshape(rows, width)
    if pa.types.is_floating(flat.type) and not np.isfinite(array).all():
        row = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
        raise DataError(
            f"{where} is not finite in row {row}: {array[row].tolist()}",
            cause="a sensor or a controller failed while this was recorded",
            next="leave that episode out: episodes=[…] without it",
        )
    return array if pa.types.is_integer(flat.type) else array.astype(np.float32, copy=False)


def all_of(column: Any, width: int) -> bool:
    """Whether every list of a column is ``width`` long."""
    pa = arrow()

    if not pa.types.is_list(column.type):
        return True
    return bool((np.diff(column.offsets.to_numpy()) == width).all())


def _no_nulls(column: Any, where: str) -> None:
    if column.null_count:
        raise DataError(f"{where} has {column.null_count} empty rows")
