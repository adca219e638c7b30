"""Videos of evaluated episodes: which are shown, recording them, and listing them in results."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fluxvla_core.contracts.environment import Environment, EnvironmentSpec
from fluxvla_core.contracts.runner import Reporter
from fluxvla_core.errors import ConfigError
from fluxvla_core.evaluation.episodes import DONE, EpisodeKey
from fluxvla_core.evaluation.pool import WorkerPool
from fluxvla_core.spec import Camera

# Tasks whose groups are all shown.
_COMPARED = 2
# What results.json says of a video.
_VIDEO_KEYS = ("group", "task", "seed", "success", "instruction")


@dataclass(frozen=True)
class VideoSettings:
    """Settings of the videos of episodes.

    Args:
        cameras: side by side; sizes as far as the environment can draw them.
        fps: frames a second of simulated time.
    """

    cameras: tuple[Camera, ...] = ()
    fps: float = 10.0

    @classmethod
    def of(
        cls,
        spec: EnvironmentSpec,
        names: Sequence[str] | None,
        height: int | None,
        width: int | None,
        fps: float,
    ) -> VideoSettings:
        """Videos of the cameras ``names``, the first one by default, in their own size by default.

        Raises:
            ConfigError: there is no such camera.
        """
        known = {camera.name: camera for camera in spec.embodiment.cameras}
        for name in names or ():
            if name not in known:
                raise ConfigError(
                    f"{name!r} is unknown; choose one of {', '.join(known) or 'none'}"
                )
        chosen = list(known.values())[:1] if names is None else [known[name] for name in names]
        sized = (
            replace(camera, height=height or camera.height, width=width or camera.width)
            for camera in chosen
        )
        return cls(tuple(sized), fps)


class VideoRecorder:
    """Records a video of an episode: call it at every step, then close it."""

    def __init__(self, path: Path, video: VideoSettings) -> None:
        self._path = path
        self._video = video
        self._writer: Any = None

    def __call__(self, environment: Environment, steps: int) -> None:
        import numpy as np

        from fluxvla_core.robot.recording.video import VideoWriter

        rate = environment.spec.embodiment.rate_hz
        stride = max(1, round(rate / self._video.fps))
        if steps % stride or not self._video.cameras:
            return
        images = environment.observe(self._video.cameras)["images"]
        views = [images[camera.name] for camera in self._video.cameras]
        lowest = min(image.shape[0] for image in views)
        frame = np.hstack([image[:lowest] for image in views])
        if self._writer is None:
            self._writer = VideoWriter(self._path, rate / stride, *frame.shape[:2])
        self._writer.add(frame)

    def close(self) -> None:
        """Finish the file."""
        if self._writer is not None:
            self._writer.close()


def choose_episodes(
    records: Sequence[Mapping[str, Any]], count: int, group: str = "policy"
) -> list[Mapping[str, Any]]:
    """Up to ``count`` records of ``group``: half failures, half successes, tasks in turn.

    Where there are not enough of one kind the other fills up. Failures come first.
    """
    mine = [r for r in records if r["group"] == group and r["status"] == DONE]
    failures = _in_turn([r for r in mine if not r["success"]])
    successes = _in_turn([r for r in mine if r["success"]])
    shown = min(len(failures), max((count + 1) // 2, count - len(successes)))
    return failures[:shown] + successes[: count - shown]


def with_others(
    shown: Sequence[Mapping[str, Any]], records: Sequence[Mapping[str, Any]]
) -> list[Mapping[str, Any]]:
    """``shown``, and one episode of each other group for its first tasks, to be seen next to it.

    One of the same seed where there is one.
    """
    best = {r["task"]: r for r in reversed(shown)} | {r["task"]: r for r in shown if r["success"]}
    groups = dict.fromkeys(r["group"] for r in records if r["status"] == DONE)
    found = list(shown)
    for task, record in list(best.items())[:_COMPARED]:
        for group in groups:
            mine = [r for r in records if (r["group"], r["task"]) == (group, task)]
            mine = [r for r in mine if r["status"] == DONE]
            if group != record["group"] and mine:
                found.append(min(mine, key=lambda r: r["seed"] != record["seed"]))
    return found


def video_name(number: int, record: Mapping[str, Any]) -> str:
    """``00-failure-TASK-seed-SEED.mp4``."""
    word = "success" if record["success"] else "failure"
    return f"{number:02d}-{word}-{record['task']}-seed-{record['seed']}.mp4"


def record_videos(
    pool: WorkerPool,
    records: Sequence[Mapping[str, Any]],
    folder: Path,
    make_job: Callable[[EpisodeKey, str], Any],
    reporter: Reporter,
) -> list[dict[str, Any]]:
    """Run the episodes of ``records`` again to record videos: they repeat exactly.

    Args:
        pool: its workers return a result with ``state_hash``, as the records have it.
        folder: where the videos go; those of an evaluation before are removed.
        make_job: from a key and a path to the job that runs it and leaves its video there.

    Returns:
        JSON values, one for each video that was made, in the order of ``records``: ``group``,
        ``task``, ``seed``, ``success``, ``instruction`` and ``path``, relative to ``folder``'s
        parent.
    """
    # Another part of the same job may be doing the same: each makes its own, then puts them there.
    part = folder / f".part-{os.getpid()}"
    part.mkdir(parents=True, exist_ok=True)
    names = [video_name(number, record) for number, record in enumerate(records)]
    jobs = [
        make_job(EpisodeKey(r["group"], r["task"], r["seed"]), str(part / name))
        for r, name in zip(records, names, strict=True)
    ]
    made = [False] * len(jobs)
    with closing(pool.run(jobs)) as outcomes:
        for done, outcome in enumerate(outcomes, 1):
            reporter.progress("videos", done, len(jobs))
            made[outcome.index] = outcome.error is None
            if outcome.error is not None:
                reporter.warn(f"no video {names[outcome.index]}: {outcome.error}")
            elif outcome.result["state_hash"] != records[outcome.index]["state_hash"]:
                reporter.warn(
                    f"{names[outcome.index]}: the episode went another way than when it was "
                    "counted; its outcome does not follow from its seed alone"
                )
    for old in folder.glob("*.mp4"):
        if old.name not in names:
            old.unlink(missing_ok=True)
    for name in names:
        made_here = part / name
        if made_here.exists():
            made_here.replace(folder / name)
    shutil.rmtree(part, ignore_errors=True)
    return [
        {
            **{key: record[key] for key in _VIDEO_KEYS if key in record},
            "path": f"{folder.name}/{name}",
        }
        for record, name, there in zip(records, names, made, strict=True)
        if there
    ]


def recorded_videos(
    recordings: Iterable[tuple[Mapping[str, Any], Path]], folder: Path
) -> list[dict[str, Any]]:
    """The videos that were recorded while the episodes ran, as :func:`record_videos` lists its own.

    Args:
        recordings: each episode's record with the folder of its recording.
        folder: of the results, to which the videos' paths are relative.
    """
    return [
        {
            **{key: record[key] for key in _VIDEO_KEYS if key in record},
            "path": Path(os.path.relpath(video, folder)).as_posix(),
        }
        for record, place in recordings
        for video in sorted(place.glob("*.mp4"))[:1]
    ]


def _in_turn(records: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    seen: dict[str, int] = {}
    ranked = []
    for record in records:
        rank = seen.get(record["task"], 0)
        seen[record["task"]] = rank + 1
        ranked.append((rank, record))
    return [record for _, record in sorted(ranked, key=lambda pair: pair[0])]
