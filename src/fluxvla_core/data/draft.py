"""One episode while it is recorded, and once it is saved: a folder of its own."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.data import lerobot_v3 as v3
from fluxvla_core.data.assemble import Episode
from fluxvla_core.data.encode import Clip, Codec, EpisodeEncoder
from fluxvla_core.data.files import write_json
from fluxvla_core.data.statistics import LEVELS, image_histogram
from fluxvla_core.errors import DataError
from fluxvla_core.spec.embodiment import EmbodimentSpec

Sizes = dict[str, tuple[int, int]]


class EpisodeDraft:
    """Frames since the last saved episode. Pictures are encoded as they come.

    Args:
        folder: where its files go; made with the first frame.
        sizes: camera -> (height, width) of earlier frames; learns from the first ones.
    """

    def __init__(
        self, folder: Path, embodiment: EmbodimentSpec, fps: float, codec: Codec, sizes: Sizes
    ) -> None:
        self.folder = folder
        self.embodiment = embodiment
        self.fps = fps
        self.codec = codec
        self.sizes = sizes
        self.task: str | None = None
        self.states: list[npt.NDArray[np.float32]] = []
        self.actions: list[npt.NDArray[np.float32]] = []
        self.histograms = {
            v3.image_feature(c): np.zeros((3, LEVELS), np.int64) for c in embodiment.camera_names
        }
        self._encoders: dict[str, EpisodeEncoder] = {}

    def __len__(self) -> int:
        return len(self.states)

    def add(
        self,
        images: Mapping[str, npt.NDArray[np.uint8]],
        state: npt.ArrayLike,
        action: npt.ArrayLike,
        task: str,
    ) -> None:
        """Check and add one frame; nothing is added if anything is wrong with it."""
        if not task.strip():
            raise DataError("add_frame: the task is empty; every episode needs an instruction")
        if self.task is not None and task != self.task:
            raise DataError(f"add_frame: task {task!r} within an episode of {self.task!r}")
        row = (
            _vector("state", state, self.embodiment.state_dim),
            _vector("action", action, self.embodiment.dim),
        )
        cameras = self.embodiment.camera_names
        if set(images) != set(cameras):
            raise DataError(
                f"add_frame: cameras {sorted(images)} given, {sorted(cameras)} expected"
            )
        for camera in cameras:
            self._check_image(camera, images[camera])
        if not self._encoders:
            self._open()
        for camera in cameras:
            self._encoders[camera].add(images[camera])
            self.histograms[v3.image_feature(camera)] += image_histogram(images[camera])
        self.task = task
        self.states.append(row[0])
        self.actions.append(row[1])

    def save(self, final: Path, key: int | None) -> None:
        """Finish the files and give the folder its final name."""
        for encoder in self._encoders.values():
            encoder.close()
        columns: dict[str, Any] = {"state": np.stack(self.states), "action": np.stack(self.actions)}
        np.savez(self.folder / "columns.npz", **columns)
        counts: dict[str, Any] = dict(self.histograms)
        np.savez(self.folder / "histograms.npz", **counts)
        write_json(self.folder / "episode.json", {"task": self.task, "key": key})
        os.replace(self.folder, final)

    def discard(self) -> None:
        """Let go of the files."""
        for encoder in self._encoders.values():
            encoder.abandon()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _open(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir()
        for camera in self.embodiment.camera_names:
            path = self.folder / f"{v3.image_feature(camera)}.mp4"
            self._encoders[camera] = EpisodeEncoder(path, *self.sizes[camera], self.fps, self.codec)

    def _check_image(self, camera: str, image: Any) -> None:
        if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
            kind = getattr(image, "dtype", type(image).__name__)
            raise DataError(f"add_frame: camera {camera!r} gives {kind}, uint8 is expected")
        if image.ndim != 3 or image.shape[2] != 3:
            raise DataError(
                f"add_frame: camera {camera!r} gives shape {image.shape}, (height, width, 3) "
                "is expected"
            )
        size = self.sizes.setdefault(camera, (image.shape[0], image.shape[1]))
        if image.shape[:2] != size:
            raise DataError(
                f"add_frame: camera {camera!r} gives {image.shape[0]} x {image.shape[1]}, "
                f"{size[0]} x {size[1]} before"
            )


def load_episode(folder: Path) -> Episode:
    """A saved episode."""
    said = json.loads((folder / "episode.json").read_text(encoding="utf-8"))
    with np.load(folder / "columns.npz") as file:
        state, action = file["state"], file["action"]
    with np.load(folder / "histograms.npz") as file:
        histograms = {key: file[key] for key in file.files}
    paths = {key: folder / f"{key}.mp4" for key in histograms}
    clips = {key: Clip(path, len(state), path.stat().st_size) for key, path in paths.items()}
    return Episode(said["task"], said["key"], state, action, clips, histograms)


def _vector(what: str, values: npt.ArrayLike, dim: int) -> npt.NDArray[np.float32]:
    array = np.array(values, np.float32)
    if array.shape != (dim,):
        raise DataError(f"add_frame: {what} has shape {array.shape}, ({dim},) is expected")
    if not np.isfinite(array).all():
        raise DataError(f"add_frame: {what} is not finite: {array.tolist()}")
    return array
