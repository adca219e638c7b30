"""The tables below ``meta/`` as version 3.0 has them: parquet."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fluxvla_core.data import lerobot_v3 as v3
from fluxvla_core.data.episodes import Episodes, FileId, VideoPlaces, check_numbering
from fluxvla_core.data.files import read_table
from fluxvla_core.data.optional import arrow
from fluxvla_core.errors import DataError


def read_tasks(root: Path) -> dict[int, Any]:
    """``task_index`` -> instruction.

    Raises:
        DataError: the table is missing, damaged, or is none of tasks.
    """
    table = read_table(root / v3.TASKS)
    text = next((n for n in ("task", "__index_level_0__") if n in table.column_names), None)
    if text is None or "task_index" not in table.column_names:
        raise DataError(f"{root / v3.TASKS}: columns {table.column_names} hold no tasks")
    return dict(zip(table["task_index"].to_pylist(), table[text].to_pylist(), strict=True))


def read_episodes(root: Path, info: Mapping[str, Any]) -> Episodes:
    """The episode table.

    Raises:
        DataError: it is missing, damaged, or not numbered through.
    """
    pa = arrow()

    paths = sorted(root.glob("meta/episodes/*/*.parquet"))
    if not paths:
        raise DataError(f"{root}: meta/episodes holds no episode table")
    videos = [k for k, f in info["features"].items() if f["dtype"] == "video"]
    columns = [
        *("episode_index", "dataset_from_index", "dataset_to_index"),
        *("data/chunk_index", "data/file_index"),
        *(
            f"videos/{k}/{n}"
            for k in videos
            for n in ("chunk_index", "file_index", "from_timestamp")
        ),
    ]
    parts = [read_table(path, columns) for path in paths]
    try:
        table = pa.concat_tables(parts, promote_options="permissive").sort_by("episode_index")
    except pa.ArrowException as error:
        raise DataError(
            f"{root}: the files of meta/episodes are not of the same columns ({error})"
        ) from error
    check_numbering(root, table["episode_index"].to_numpy())

    def files(prefix: str) -> list[FileId]:
        chunk, file = (table[f"{prefix}/{n}_index"].to_pylist() for n in ("chunk", "file"))
        return list(zip(chunk, file, strict=True))

    return Episodes(
        table["dataset_from_index"].to_numpy().astype(np.int64),
        table["dataset_to_index"].to_numpy().astype(np.int64),
        files("data"),
        {
            k: VideoPlaces(files(f"videos/{k}"), table[f"videos/{k}/from_timestamp"].to_numpy())
            for k in videos
        },
    )
