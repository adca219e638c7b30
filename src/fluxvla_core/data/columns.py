"""Load a dataset's columns into memory, and find its camera frames in their files.

Also checks whether datasets that are used together are of one robot.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.data.files import arrow, read_json, read_table
from fluxvla_core.data.metadata import FileId, Metadata, read_metadata
from fluxvla_core.data.video_decode import (
    ExpectedVideo,
    ImageColumn,
    ImageColumnReader,
    Source,
    check_video,
)
from fluxvla_core.errors import DataError, SpecMismatch
from fluxvla_core.spec import EmbodimentSpec, check_match

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Track:
    """Index of one camera's frames: frame ``row`` is in ``files[file[row]]`` at ``time[row]`` s.

    For image columns of parquet files, ``time`` is the row in the file.
    """

    key: str
    files: tuple[Source, ...]
    file: npt.NDArray[np.int32]
    time: npt.NDArray[np.float64]
    height: int
    width: int


@dataclass(frozen=True)
class LoadedDataset:
    """A dataset in memory: all ``N`` rows of its episodes, and which of them are used.

    ``states`` and ``actions`` are ``(N, D)`` float32; ``state_names`` and ``action_names`` have D
    entries, or none. ``start`` and ``end`` ``(N,)`` are the rows that a row's episode begins at
    and ends before. ``chosen`` are the rows of the chosen episodes, ``rows`` those of them that a
    sample can be made of.
    """

    meta: Metadata
    states: Floats
    actions: Floats
    state_names: tuple[str, ...]
    action_names: tuple[str, ...]
    timestamp: Floats
    task: npt.NDArray[np.int64]
    episode: npt.NDArray[np.int64]
    start: npt.NDArray[np.int64]
    end: npt.NDArray[np.int64]
    chosen: npt.NDArray[np.int64]
    rows: npt.NDArray[np.int64]
    tracks: tuple[Track, ...]


def load_dataset(
    root: Path,
    cameras: Sequence[str],
    state_key: str,
    action_key: str,
    first_action: int,
    episodes: Sequence[int] | None,
) -> LoadedDataset:
    """Load a dataset's columns and check that its files are complete.

    Args:
        cameras: features, or cameras' short names, in the order of a sample's images.
        first_action: rows from the current one to the first action of its window; rows whose
            window would begin after their episode's end are not used.
        episodes: the ones to use; all by default.

    Raises:
        DataError: see ``read_metadata``, ``read_columns`` and ``check_video``; an episode that
            does not exist; nothing left to use.
    """
    meta = read_metadata(root)
    keys = [meta.camera(camera) for camera in cameras]
    chosen = _choose(meta, episodes)
    columns = read_columns(meta, [state_key, action_key])
    lengths = meta.episodes.lengths
    start = np.repeat(meta.episodes.first_row, lengths)
    end = np.repeat(meta.episodes.end_row, lengths)
    row = np.arange(len(start))
    of_chosen = np.repeat(chosen, lengths)
    used = of_chosen & (row + first_action < end)
    if not used.any():
        raise DataError(
            f"{root}: no frame can be used",
            cause=f"episodes are no longer than window_start_idx {first_action}"
            if episodes is None
            else "episodes=[] chooses none",
        )
    check_tasks(meta, columns["task_index"])
    tracks = tuple(make_track(meta, key, columns["timestamp"], chosen) for key in keys)
    return LoadedDataset(
        meta=meta,
        states=columns[state_key],
        actions=columns[action_key],
        state_names=tuple(meta.names(state_key)),
        action_names=tuple(meta.names(action_key)),
        timestamp=columns["timestamp"],
        task=columns["task_index"],
        episode=columns["episode_index"],
        start=start,
        end=end,
        chosen=row[of_chosen],
        rows=row[used],
        tracks=tracks,
    )


def read_columns(meta: Metadata, vectors: Sequence[str]) -> dict[str, Array]:
    """Read all rows of the dataset, each column one array in the order of its rows.

    ``vectors`` come as ``(N, D)`` float32; ``timestamp`` ``(N,)`` float32, ``episode_index`` and
    ``task_index`` ``(N,)`` int64 are always included.

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
        table = read_table(path, names, expected)
        for name in names:
            column = table[name].combine_chunks()
            where = f"{path}: column {name!r}"
            width = widths.get(name)
            if width is None:
                array = _scalars(column, where, name == "timestamp")
            else:
                array = _vectors(column, width, where)
            parts[name].append(array)
    columns = {name: np.concatenate(arrays) for name, arrays in parts.items()}
    _check_rows(meta, columns["episode_index"])
    return columns


def has_width(column: Any, width: int) -> bool:
    """Whether every list of a column is ``width`` long."""
    pa = arrow()

    if not pa.types.is_list(column.type):
        return True
    return bool((np.diff(column.offsets.to_numpy()) == width).all())


def check_tasks(meta: Metadata, index: npt.NDArray[Any]) -> None:
    """Check that every row's task is one that the dataset lists.

    Raises:
        DataError: a row's is not.
    """
    known = len(meta.tasks)
    if index.min() < 0 or index.max() >= known:
        raise DataError(
            f"{meta.root}: task_index runs from {index.min()} to {index.max()}, "
            f"{meta.tasks_file} lists {known} tasks"
        )


def make_track(
    meta: Metadata,
    key: str,
    timestamp: Floats,
    chosen: npt.NDArray[np.bool_],
    check: Callable[[Path, ExpectedVideo], None] = check_video,
) -> Track:
    """Find the frames of camera ``key`` in its files.

    Args:
        chosen: the episodes to find, ``(E,)``.
        check: called with each video file and what it must hold.

    Raises:
        DataError: a file of a chosen episode is missing or too short, or has another image size
            or rate.
    """
    if meta.features[key]["dtype"] == "image":
        return _stored_track(meta, key)
    places = meta.episodes.videos[key]
    lengths = meta.episodes.lengths
    # Only the files of the chosen episodes: a part of a dataset can be copied and trained on.
    wanted = [f for f, use in zip(places.files, chosen, strict=True) if use]
    numbers = {f: i for i, f in enumerate(dict.fromkeys(wanted))}
    files = tuple(meta.video_file(key, f) for f in numbers)
    ends = [0] * len(files)
    for start, length, place in zip(places.starts[chosen], lengths[chosen], wanted, strict=True):
        ends[numbers[place]] = max(ends[numbers[place]], round(start * meta.fps) + int(length))
    height, width = meta.image_size(key)
    for path, end in zip(files, ends, strict=True):
        check(path, ExpectedVideo(end, height, width, meta.fps))
    file = [numbers.get(f, -1) for f in places.files]
    return Track(
        key=key,
        files=files,
        file=np.repeat(np.array(file, np.int32), lengths),
        time=np.repeat(places.starts, lengths) + timestamp.astype(np.float64),
        height=height,
        width=width,
    )


def check_compatible(datasets: Sequence[LoadedDataset]) -> None:
    """Check that datasets have one robot, rate, width, and order of the joints.

    Raises:
        SpecMismatch, DataError: naming both datasets and what differs.
    """
    first = datasets[0]
    for other in datasets[1:]:
        one, two = first.meta, other.meta
        if one.embodiment is not None and two.embodiment is not None:
            check_match(one.embodiment, two.embodiment, str(one.root), str(two.root), ())
        for what, left, right in (
            ("fps", one.fps, two.fps),
            ("width of the state", first.states.shape[1], other.states.shape[1]),
            ("width of the action", first.actions.shape[1], other.actions.shape[1]),
        ):
            if left != right:
                raise DataError(
                    f"{one.root} and {two.root} do not go together: {what}: {left} / {right}"
                )
        for what, expected, actual in _names(first, other):
            if expected != actual and sorted(expected) == sorted(actual):
                raise DataError(
                    f"{one.root} and {two.root} do not go together: {what}: the same names in "
                    f"another order: {', '.join(expected)} / {', '.join(actual)}",
                    next="write one of them again with its columns in the order of the other",
                )


def naming_warnings(datasets: Sequence[LoadedDataset]) -> list[str]:
    """Warnings for datasets whose states or actions have other names: it may be another robot."""
    first = datasets[0]
    return [
        f"{first.meta.root} and {other.meta.root} are used as one robot's, but {what} have other "
        f"names: {', '.join(here)} / {', '.join(there)}"
        for other in datasets[1:]
        for what, here, there in _names(first, other)
        if here != there
    ]


def find_embodiment(
    datasets: Sequence[LoadedDataset], configured: Mapping[str, Any] | str | None
) -> EmbodimentSpec | None:
    """The robot that the datasets were recorded with: from their metadata, else ``configured``.

    Raises:
        SpecMismatch: metadata and ``configured`` differ; or the numbers of the robot's joints and
            of the data's columns do.
        DataError: ``configured`` is a path that cannot be read.
    """
    embodiment = next((r.meta.embodiment for r in datasets if r.meta.embodiment is not None), None)
    root, first = datasets[0].meta.root, datasets[0]
    if configured is not None:
        table = read_json(Path(configured)) if isinstance(configured, str) else configured
        spec = EmbodimentSpec.from_dict(table)
        if embodiment is not None:
            check_match(spec, embodiment, "the config's embodiment", str(root), ())
        embodiment = spec
    if embodiment is None:
        return None
    for what, joints, columns in (
        ("states", embodiment.state_dim, first.states.shape[1]),
        ("actions", embodiment.dim, first.actions.shape[1]),
    ):
        if joints != columns:
            raise SpecMismatch(
                f"{root}: {what} have {columns} columns, "
                f"the robot {embodiment.name} has {joints} joints",
                next="name the features that belong to the robot: state_key and action_key",
            )
    return embodiment


def _choose(meta: Metadata, episodes: Sequence[int] | None) -> npt.NDArray[np.bool_]:
    count = len(meta.episodes)
    chosen = np.full(count, episodes is None)
    for episode in episodes or ():
        if not 0 <= episode < count:
            raise DataError(
                f"{meta.root}: there is no episode {episode}; there are 0 to {count - 1}"
            )
        chosen[episode] = True
    return chosen


def _check_rows(meta: Metadata, episode_of_row: Array) -> None:
    episodes = meta.episodes
    expected = np.repeat(np.arange(len(episodes)), episodes.lengths)
    inside = np.array_equal(episodes.first_row, np.append(0, episodes.end_row[:-1]))
    if not inside or not np.array_equal(episode_of_row, expected):
        raise DataError(
            f"{meta.root}: the rows of the data files are not those that the episode table lists",
            cause="files of two recordings were mixed, or the episode table was edited",
        )


def _scalars(column: Any, where: str, times: bool) -> Array:
    # A single number in a list is what older versions wrote.
    array: Array = _vectors(column, 1, where)[:, 0]
    if not times and not np.issubdtype(array.dtype, np.integer):
        raise DataError(f"{where} holds {column.type}, not whole numbers")
    return array if times else array.astype(np.int64)


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
    if len(flat) != rows * width or not has_width(column, width):
        raise DataError(
            f"{where} does not hold {width} numbers in every row, as info.json says; "
            f"it is {column.type}"
        )
    if not (pa.types.is_floating(flat.type) or pa.types.is_integer(flat.type)):
        raise DataError(f"{where} holds {flat.type}, not numbers")
    _no_nulls(flat, where)
    array: Array = flat.to_numpy(zero_copy_only=False).reshape(rows, width)
    if pa.types.is_floating(flat.type):
        with np.errstate(over="ignore"):  # the next line finds it
            array = array.astype(np.float32, copy=False)
    if pa.types.is_floating(flat.type) and not np.isfinite(array).all():
        row = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
        raise DataError(
            f"{where} is not finite in row {row}: {array[row].tolist()}",
            cause="a sensor or a controller failed while this was recorded",
            next="leave that episode out: episodes=[…] without it",
        )
    return array


def _no_nulls(column: Any, where: str) -> None:
    if column.null_count:
        raise DataError(f"{where} has {column.null_count} empty rows")


def _stored_track(meta: Metadata, key: str) -> Track:
    """The track of an image column: in the parquet files, which are read in any case."""
    numbers = {f: i for i, f in enumerate(dict.fromkeys(meta.episodes.files))}
    height, width = meta.image_size(key)
    files = tuple(ImageColumn(meta.data_file(f), key, (height, width)) for f in numbers)
    for column in files:
        ImageColumnReader(column).close()
    of_episode = np.array([numbers[f] for f in meta.episodes.files], np.int32)
    file = np.repeat(of_episode, meta.episodes.lengths)
    first = np.unique(file, return_index=True)[1]
    row = (np.arange(len(file)) - first[file]).astype(np.float64)
    return Track(key, files, file, row, height, width)


def _names(
    one: LoadedDataset, two: LoadedDataset
) -> list[tuple[str, tuple[str, ...], tuple[str, ...]]]:
    """The names of states and of actions in both, where both have names."""
    pairs = (
        ("states", one.state_names, two.state_names),
        ("actions", one.action_names, two.action_names),
    )
    return [pair for pair in pairs if pair[1] and pair[2]]
