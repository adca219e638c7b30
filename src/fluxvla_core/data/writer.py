"""Recording a dataset, episode by episode, so that a crash leaves either it or what was saved.

Everything goes into a folder of its own beside the dataset, ``.<name>.writing``. An episode is
there once its folder has its final name; the dataset is there once ``finalize`` has renamed it.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.data import lerobot_v3 as v3
from fluxvla_core.data.assemble import Recording, assemble
from fluxvla_core.data.draft import EpisodeDraft, Sizes, load_episode
from fluxvla_core.data.encode import find_codec
from fluxvla_core.data.files import read_json, write_json
from fluxvla_core.errors import DataError, RunFailed
from fluxvla_core.spec.embodiment import EmbodimentSpec

_RECORDING = "recording.json"


class LeRobotWriter:
    """Writes a LeRobot v3.0 dataset.

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
        recover: go on with the episodes of a recording that was interrupted.

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
        data_file_mb: float = v3.DATA_FILE_MB,
        video_file_mb: float = v3.VIDEO_FILE_MB,
        recover: bool = False,
    ) -> None:
        self.root = Path(root)
        self._codec = find_codec(video_codec)
        self._recording = Recording(
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
            self._take_over(recover)
        make_staging(self._staging)
        self._draft = self._new_draft()

    @property
    def episodes(self) -> int:
        """Episodes saved so far."""
        return len(self._saved)

    @property
    def frames(self) -> int:
        """Frames of the episode that is being recorded."""
        return len(self._draft)

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
            self._draft.add(images, state, action, task)
        except OSError as error:
            raise self._disk(error) from error

    def save_episode(self, key: int | None = None) -> int:
        """Keep the episode; returns its number.

        Args:
            key: its place among episodes that other processes record, for example its seed;
                ``merge_datasets`` sorts by it.

        Raises:
            DataError: no frame was added.
            RunFailed: the disk is full; the episodes before are safe.
        """
        if not len(self._draft):
            raise DataError("save_episode: no frame was added since the last episode")
        number = len(self._saved)
        final = self._staging / f"episode-{number:06d}"
        try:
            write_json(self._staging / _RECORDING, {"sizes": self._sizes, **self._settings()})
            self._draft.save(final, key)
        except OSError as error:
            raise self._disk(error) from error
        self._saved.append(final)
        self._draft = self._new_draft()
        return number

    def discard_episode(self) -> None:
        """Forget the frames since the last episode."""
        self._draft.discard()
        self._draft = self._new_draft()

    def finalize(self) -> Path:
        """Write the dataset and remove the staging folder; returns the dataset's path.

        Raises:
            DataError: no episode was saved, or frames were added after the last one.
            RunFailed: the disk is full; the saved episodes are safe.
        """
        if len(self._draft):
            raise DataError(
                f"finalize: {len(self._draft)} frames belong to no episode",
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
        else:
            self.discard_episode()

    def _take_over(self, recover: bool) -> None:
        saved = sorted(self._staging.glob("episode-*"))
        if not recover:
            raise DataError(
                f"{self.root}: a recording was interrupted, or is under way: "
                f"{len(saved)} saved episodes in {self._staging}",
                next="LeRobotWriter(..., recover=True) goes on with them; or delete that folder",
            )
        if saved:
            said = read_json(self._staging / _RECORDING)
            self._check_settings(said)
            self._sizes = {camera: (size[0], size[1]) for camera, size in said["sizes"].items()}
        self._saved = saved

    def _settings(self) -> dict[str, Any]:
        """What all episodes of a recording share, as JSON values."""
        about = self._recording
        settings = {
            "fps": about.fps,
            "video_codec": about.video_codec,
            "embodiment": about.embodiment.to_dict(),
        }
        return dict(json.loads(json.dumps(settings)))

    def _check_settings(self, said: Mapping[str, Any]) -> None:
        """Refuse to go on with episodes of another robot, rate or codec."""
        here = self._settings()
        other = [key for key in here if key not in said or said[key] != here[key]]
        if not other:
            return
        listed = [k if k == "embodiment" else f"{k}: {said.get(k)} / {here[k]}" for k in other]
        raise DataError(
            f"{self.root}: the recording that was interrupted has another {', '.join(listed)}",
            cause="what was saved and what is to come would not be read alike",
            next="record with the settings of then, or into another folder",
        )

    def _new_draft(self) -> EpisodeDraft:
        spec, fps = self._recording.embodiment, self._recording.fps
        return EpisodeDraft(self._staging / "part", spec, fps, self._codec, self._sizes)

    def _sized(self) -> Recording:
        """The recording with the pictures' true sizes in its embodiment."""
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
            "make room, then LeRobotWriter(..., recover=True).finalize()",
        )


def staging_of(root: Path) -> Path:
    """Where a dataset is while it is written."""
    return root.with_name(f".{root.name}.writing")


def make_staging(staging: Path) -> None:
    """Make the folder that a dataset is written in.

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
def built_aside(target: Path, safe: str, next: str) -> Iterator[Path]:
    """A folder to write the dataset ``target`` into; it appears there if nothing is raised.

    Args:
        safe, next: what to say when the disk is full.

    Raises:
        DataError: ``target`` exists, is under way, or cannot be written.
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
    """What to raise for ``error``: RunFailed when the disk is full, else ``error`` itself."""
    if error.errno != errno.ENOSPC:
        return error
    return RunFailed(f"{root}: no space left on the disk", cause=safe, next=next)


def check_absent(root: Path) -> None:
    """Refuse to write over anything.

    Raises:
        DataError: ``root`` exists and is not an empty folder.
    """
    if root.exists() and (not root.is_dir() or any(root.iterdir())):
        raise DataError(
            f"{root}: there is something here already; a dataset is never written over",
            next="choose another folder, or delete this one",
        )


def publish(built: Path, root: Path) -> None:
    """Put a finished dataset in its place in one step, with its files safely on the disk."""
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
