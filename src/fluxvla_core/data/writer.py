"""``LeRobotWriter``: record a dataset episode by episode; a crash loses at most the current one.

Everything goes into a staging folder next to the dataset, ``.<name>.writing``. An episode is saved
once its folder has its final name; the dataset exists once ``finalize`` has renamed the folder.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any
from zipfile import BadZipFile

import numpy as np
import numpy.typing as npt

from fluxvla_core import untrusted
from fluxvla_core.data import lerobot
from fluxvla_core.data.assemble import DatasetSettings, Episode, assemble
from fluxvla_core.data.files import (
    check_absent,
    explain_disk,
    make_staging,
    publish,
    read_json,
    staging_of,
    write_metadata,
)
from fluxvla_core.data.statistics import LEVELS, image_histogram
from fluxvla_core.data.video_encode import Clip, Codec, EpisodeEncoder, find_codec
from fluxvla_core.errors import DataError
from fluxvla_core.spec import EmbodimentSpec
from fluxvla_core.untrusted import checked

_RECORDING = "recording.json"
Sizes = dict[str, tuple[int, int]]


class LeRobotWriter:
    """Record a LeRobot v3.0 dataset.

    Use it as a context manager: leaving it normally finalizes; leaving it by an exception keeps
    the saved episodes in the staging folder, where ``recover=True`` finds them.

    Args:
        root: the dataset's folder; it must not exist yet, or be empty.
        fps: frames per second of the recording, which may be below the robot's ``rate_hz``.
        embodiment: the robot; its cameras and joints name the features. The cameras' sizes are
            taken from the first frame.
        robot_type: LeRobot's name of the robot; the embodiment's by default.
        video_codec: ``h264`` (decodes everywhere, encodes fast) or ``libsvtav1`` (smaller).
        data_file_mb, video_file_mb: a file that would get larger is followed by another.
        recover: continue with the episodes of a recording that was interrupted.
        go_on: how to continue, for the message when the disk is full.

    Raises:
        DataError: there is a dataset, or an interrupted recording, already; with ``recover``, that
            one is of another robot, rate or codec.
        ConfigError: the codec is unknown or not available.
    """

    def __init__(
        self,
        root: str | Path,
        fps: float,
        embodiment: EmbodimentSpec,
        robot_type: str | None = None,
        video_codec: str = "h264",
        data_file_mb: float = lerobot.DATA_FILE_MB,
        video_file_mb: float = lerobot.VIDEO_FILE_MB,
        recover: bool = False,
        go_on: str = "LeRobotWriter(..., recover=True).finalize()",
    ) -> None:
        self.root = Path(root)
        self._go_on = go_on
        self._codec = find_codec(video_codec)
        self._recording = DatasetSettings(
            float(fps),
            embodiment,
            video_codec,
            robot_type if robot_type is not None else embodiment.name,
            data_file_mb,
            video_file_mb,
        )
        check_absent(self.root)
        self._staging = staging_of(self.root)
        self._sizes: Sizes = {}
        self._saved: list[Path] = []
        if self._staging.exists():
            self._continue_recording(recover)
        make_staging(self._staging)
        self._buffer = self._new_buffer()

    @property
    def episodes(self) -> int:
        """Episodes saved so far."""
        return len(self._saved)

    @property
    def frames(self) -> int:
        """Frames of the episode that is being recorded."""
        return len(self._buffer)

    def add_frame(
        self,
        images: Mapping[str, npt.NDArray[np.uint8]],
        state: npt.ArrayLike,
        action: npt.ArrayLike,
        task: str,
    ) -> None:
        """Add one frame to the episode.

        Args:
            images: camera name -> ``(height, width, 3)`` uint8 RGB, one for each camera.
            state: ``(state_dim,)``; action: ``(dim,)``, in the embodiment's units.
            task: the instruction, the same for the whole episode.

        Raises:
            DataError: anything of another shape, type or size than the frames before; numbers
                that are not finite; another task; a missing or unknown camera.
            RunFailed: the disk is full.
        """
        try:
            self._buffer.add(images, state, action, task)
        except OSError as error:
            raise self._disk(error) from error

    def save_episode(self, key: int | None = None) -> int:
        """Save the episode; returns its number.

        Args:
            key: its place among episodes that other processes record, for example its seed;
                ``merge_datasets`` sorts by it.

        Raises:
            DataError: no frame was added.
            RunFailed: the disk is full; the episodes before are safe.
        """
        if not len(self._buffer):
            raise DataError("save_episode: no frame was added since the last episode")
        number = len(self._saved)
        final = self._staging / f"episode-{number:06d}"
        try:
            write_metadata(self._staging / _RECORDING, {"sizes": self._sizes, **self._settings()})
            self._buffer.save(final, key)
        except OSError as error:
            raise self._disk(error) from error
        self._saved.append(final)
        self._buffer = self._new_buffer()
        return number

    def discard_episode(self) -> None:
        """Drop the frames since the last episode."""
        self._buffer.discard()
        self._buffer = self._new_buffer()

    def finalize(self) -> Path:
        """Write the dataset and remove the staging folder; returns the dataset's path.

        Raises:
            DataError: no episode was saved, or frames were added after the last one.
            RunFailed: the disk is full; the saved episodes are safe.
        """
        if len(self._buffer):
            raise DataError(
                f"finalize: {len(self._buffer)} frames belong to no episode",
                next="call save_episode() or discard_episode() first",
            )
        if not self._saved:
            raise DataError(f"{self.root}: no episode was saved, so there is no dataset to write")
        built = self._staging / "dataset"
        shutil.rmtree(built, ignore_errors=True)
        try:
            built.mkdir()
            assemble([load_episode(path) for path in self._saved], built, self._sized())
            publish(built, self.root)
        except OSError as error:
            raise self._disk(error) from error
        shutil.rmtree(self._staging)
        return self.root

    def __enter__(self) -> LeRobotWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.finalize()
            return
        self.discard_episode()
        # Frames of the first episode were refused: there is nothing to continue with.
        if isinstance(error, DataError) and not any(self._staging.rglob("episode-*")):
            shutil.rmtree(self._staging, ignore_errors=True)

    def _continue_recording(self, recover: bool) -> None:
        saved = sorted(self._staging.glob("episode-*"))
        if not recover:
            raise DataError(
                f"{self.root}: a recording was interrupted, or is under way: "
                f"{len(saved)} saved episodes in {self._staging}",
                next="LeRobotWriter(..., recover=True) continues with them; or delete that folder",
            )
        if saved:
            before = read_json(self._staging / _RECORDING)
            self._check_settings(before)
            sizes = checked(before.get("sizes"), dict[str, tuple[int, int]], DataError, _RECORDING)
            self._sizes = dict(sizes)
        self._saved = saved

    def _settings(self) -> dict[str, Any]:
        """Settings shared by all episodes of a recording, as JSON values."""
        about = self._recording
        settings = {
            "fps": about.fps,
            "video_codec": about.video_codec,
            "embodiment": about.embodiment.to_dict(),
        }
        return dict(json.loads(json.dumps(settings)))

    def _check_settings(self, before: Mapping[str, Any]) -> None:
        """Refuse to continue with episodes of another robot, rate or codec."""
        here = self._settings()
        other = [key for key in here if key not in before or before[key] != here[key]]
        if not other:
            return
        listed = [k if k == "embodiment" else f"{k}: {before.get(k)} / {here[k]}" for k in other]
        raise DataError(
            f"{self.root}: the recording that was interrupted has another {', '.join(listed)}",
            cause="what was saved and what is to come would not be read alike",
            next="record with the settings of then, or into another folder",
        )

    def _new_buffer(self) -> EpisodeBuffer:
        spec, fps = self._recording.embodiment, self._recording.fps
        return EpisodeBuffer(self._staging / "part", spec, fps, self._codec, self._sizes)

    def _sized(self) -> DatasetSettings:
        """The recording with the images' true sizes in its embodiment."""
        spec = self._recording.embodiment
        cameras = tuple(
            replace(c, height=self._sizes[c.name][0], width=self._sizes[c.name][1])
            for c in spec.cameras
        )
        return replace(self._recording, embodiment=replace(spec, cameras=cameras))

    def _disk(self, error: OSError) -> Exception:
        return explain_disk(
            error,
            self.root,
            f"{len(self._saved)} saved episodes are safe in {self._staging}",
            f"make room, then {self._go_on}",
        )


class EpisodeBuffer:
    """The frames since the last saved episode. Images are encoded as they come.

    Args:
        folder: where its files go; made with the first frame.
        sizes: camera -> (height, width) of earlier frames; filled from the first ones.
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
            lerobot.image_feature(c): np.zeros((3, LEVELS), np.int64)
            for c in embodiment.camera_names
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
            self.histograms[lerobot.image_feature(camera)] += image_histogram(images[camera])
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
        write_metadata(self.folder / "episode.json", {"task": self.task, "key": key})
        os.replace(self.folder, final)

    def discard(self) -> None:
        """Delete the files."""
        for encoder in self._encoders.values():
            encoder.abandon()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _open(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir()
        for camera in self.embodiment.camera_names:
            path = self.folder / f"{lerobot.image_feature(camera)}.mp4"
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
    """Load a saved episode.

    Raises:
        DataError: it cannot be read as one.
    """
    about = untrusted.read_json(folder / "episode.json", _SavedAbout, DataError)
    try:
        with np.load(folder / "columns.npz") as file:
            state, action = file["state"], file["action"]
        with np.load(folder / "histograms.npz") as file:
            histograms = {key: file[key] for key in file.files}
    except (KeyError, ValueError, EOFError, BadZipFile) as error:
        raise DataError(
            f"{folder}: a saved episode cannot be read ({error})",
            cause="the disk lost a part of it, or it was changed",
        ) from error
    paths = {key: folder / f"{key}.mp4" for key in histograms}
    clips = {key: Clip(path, len(state), path.stat().st_size) for key, path in paths.items()}
    return Episode(about.task, about.key, state, action, clips, histograms)


@dataclass(frozen=True)
class _SavedAbout:
    task: str
    key: int | None = None


def _vector(what: str, values: npt.ArrayLike, dim: int) -> npt.NDArray[np.float32]:
    array = np.array(values, np.float32)
    if array.shape != (dim,):
        raise DataError(f"add_frame: {what} has shape {array.shape}, ({dim},) is expected")
    if not np.isfinite(array).all():
        raise DataError(f"add_frame: {what} is not finite: {array.tolist()}")
    return array
