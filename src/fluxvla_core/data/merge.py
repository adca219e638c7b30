"""Datasets that parallel processes recorded, joined to the one that one process would have."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fluxvla_core.data import lerobot_v3 as v3
from fluxvla_core.data.assemble import Episode, Recording, assemble
from fluxvla_core.data.columns import read_columns
from fluxvla_core.data.encode import CODECS, Clip
from fluxvla_core.data.files import read_table
from fluxvla_core.data.metadata import Metadata, read_metadata
from fluxvla_core.data.writer import built_aside, check_absent
from fluxvla_core.errors import DataError
from fluxvla_core.spec.embodiment import check_match


def merge_datasets(roots: Sequence[str | Path], out: str | Path) -> Path:
    """Join datasets that :class:`LeRobotWriter` wrote; returns ``out``.

    Episodes come in the order of the keys that ``save_episode`` was given, so the result does not
    depend on how they were shared out among processes; without keys, in the order of ``roots``.
    Videos are copied, not encoded again. The sources stay as they are.

    Raises:
        DataError: a source is damaged, was written by another program, or differs in fps, codec
            or cameras; a key occurs twice; ``out`` exists.
        SpecMismatch: the sources were recorded with different robots.
        RunFailed: the disk is full.
    """
    target = Path(out)
    check_absent(target)
    if not roots:
        raise DataError("merge_datasets: no datasets were given")
    metas = [read_metadata(Path(root)) for root in roots]
    recording = _recording(metas[0])
    for meta in metas[1:]:
        _check_alike(recording, metas[0], meta)
    episodes = _sorted([episode for meta in metas for episode in _episodes(meta)])
    safe = "the datasets that were to be merged are as they were"
    with built_aside(target, safe, "make room and merge again") as staging:
        assemble(episodes, staging, recording)
    return target


def _recording(meta: Metadata) -> Recording:
    if meta.embodiment is None or not (meta.root / v3.EXTRAS).is_file():
        raise DataError(
            f"{meta.root}: only datasets that LeRobotWriter wrote can be merged",
            cause=f"{v3.EMBODIMENT} or {v3.EXTRAS} is missing: another program wrote it",
        )
    streams = {meta.features[k]["info"]["video.codec"] for k in meta.cameras}
    codec = next((name for name, c in CODECS.items() if streams <= {c.stream}), None)
    if codec is None:
        raise DataError(f"{meta.root}: video codecs {sorted(streams)} cannot be merged")
    return Recording(
        meta.fps,
        meta.embodiment,
        codec,
        meta.info["robot_type"],
        meta.info["data_files_size_in_mb"],
        meta.info["video_files_size_in_mb"],
    )


def _check_alike(first: Recording, one: Metadata, other: Metadata) -> None:
    second = _recording(other)
    check_match(first.embodiment, second.embodiment, str(one.root), str(other.root))
    for what, left, right in (
        ("fps", first.fps, second.fps),
        ("video codec", first.video_codec, second.video_codec),
        ("cameras", first.embodiment.cameras, second.embodiment.cameras),
    ):
        if left != right:
            raise DataError(
                f"{one.root} and {other.root} cannot be merged: {what}: {left} / {right}"
            )


def _episodes(meta: Metadata) -> list[Episode]:
    columns = read_columns(meta, [v3.STATE, v3.ACTION])
    extras = read_table(meta.root / v3.EXTRAS)
    keys = extras["key"].to_pylist()
    histograms = {
        camera: extras[f"histogram/{camera}"].combine_chunks().flatten().to_numpy()
        for camera in meta.cameras
    }
    sizes = {camera: extras[f"bytes/{camera}"].to_pylist() for camera in meta.cameras}
    table = meta.episodes
    found = []
    for i in range(len(table)):
        rows = slice(table.first_row[i], table.end_row[i])
        found.append(
            Episode(
                meta.tasks[columns["task_index"][rows.start]],
                keys[i],
                columns[v3.STATE][rows],
                columns[v3.ACTION][rows],
                {camera: _clip(meta, camera, i, sizes[camera][i]) for camera in meta.cameras},
                {
                    camera: counts.reshape(-1, 3, 256)[i].astype(np.int64)
                    for camera, counts in histograms.items()
                },
            )
        )
    return found


def _clip(meta: Metadata, camera: str, episode: int, size: int) -> Clip:
    places = meta.episodes.videos[camera]
    path = meta.video_file(camera, places.files[episode])
    return Clip(path, int(meta.episodes.lengths[episode]), size, float(places.starts[episode]))


def _sorted(episodes: list[Episode]) -> list[Episode]:
    keys = [episode.key for episode in episodes if episode.key is not None]
    if not keys:
        return episodes
    if len(keys) != len(episodes):
        raise DataError(
            f"merge_datasets: {len(keys)} of {len(episodes)} episodes have a key",
            cause="save_episode(key=…) was called with a key for some episodes only",
        )
    twice = sorted({key for key in keys if keys.count(key) > 1})
    if twice:
        raise DataError(
            f"merge_datasets: {len(twice)} keys occur twice, for example {twice[0]}",
            cause="two processes recorded the same seeds",
        )
    return sorted(episodes, key=lambda episode: episode.key or 0)
