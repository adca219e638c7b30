"""One dataset in memory: its columns whole, its pictures as places in video files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.data.columns import read_columns
from fluxvla_core.data.metadata import Metadata, read_metadata
from fluxvla_core.data.stored_images import ImageColumn, StoredImages
from fluxvla_core.data.video import Source, check_video
from fluxvla_core.errors import DataError

Floats = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Track:
    """One camera: frame ``row`` is in ``files[file[row]]`` at ``time[row]`` seconds.

    Of pictures that stand in tables, ``time`` is the row in the file.
    """

    key: str
    files: tuple[Source, ...]
    file: npt.NDArray[np.int32]
    time: npt.NDArray[np.float64]
    height: int
    width: int


@dataclass(frozen=True)
class Recorded:
    """A dataset's rows, ``N`` over all its episodes, and which of them are used.

    ``states`` and ``actions`` are ``(N, D)`` float32, with a name for each of the D if they have
    names; ``start`` and ``end`` ``(N,)`` are the rows
    that a row's episode begins at and ends before; ``chosen`` are the rows of the chosen episodes,
    ``rows`` those of them that a sample can be made of.
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


def load_recorded(
    root: Path,
    cameras: Sequence[str],
    state_key: str,
    action_key: str,
    first_action: int,
    episodes: Sequence[int] | None,
) -> Recorded:
    """Read a dataset's columns and check that its files are whole.

    Args:
        cameras: features, or cameras' short names, in the order that samples show them.
        first_action: rows from the present one to a window's first action; rows whose window
            would begin after their episode's end are not used.
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
    return Recorded(
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


def check_tasks(meta: Metadata, index: npt.NDArray[Any]) -> None:
    """Refuse rows of an instruction that the dataset does not list.

    Raises:
        DataError: there are some.
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
    check: Callable[[Path, int], None] = check_video,
) -> Track:
    """Where the frames of camera ``key`` are.

    Args:
        chosen: the episodes to find, ``(E,)``.
        check: is given each video file and how many frames must be in it.

    Raises:
        DataError: a file of a chosen episode is missing or too short.
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
    for path, end in zip(files, ends, strict=True):
        check(path, end)
    file = [numbers.get(f, -1) for f in places.files]
    height, width = meta.picture_size(key)
    return Track(
        key=key,
        files=files,
        file=np.repeat(np.array(file, np.int32), lengths),
        time=np.repeat(places.starts, lengths) + timestamp.astype(np.float64),
        height=height,
        width=width,
    )


def _stored_track(meta: Metadata, key: str) -> Track:
    """Of pictures that stand in the tables, which are read for their columns in any case."""
    numbers = {f: i for i, f in enumerate(dict.fromkeys(meta.episodes.files))}
    files = tuple(ImageColumn(meta.data_file(f), key) for f in numbers)
    for column in files:
        StoredImages(column).close()
    of_episode = np.array([numbers[f] for f in meta.episodes.files], np.int32)
    file = np.repeat(of_episode, meta.episodes.lengths)
    first = np.unique(file, return_index=True)[1]
    row = (np.arange(len(file)) - first[file]).astype(np.float64)
    height, width = meta.picture_size(key)
    return Track(key, files, file, row, height, width)
