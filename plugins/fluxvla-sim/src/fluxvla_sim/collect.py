"""Demonstrations in parallel, written as one LeRobot v3.0 dataset.

Episode ``k`` is acted out with seed ``seed + k``; where the expert fails, with the next of that
episode's own spare seeds. One process writes, in the order of the episodes. So the dataset is the
same for any number of workers, and a collection that was interrupted can go on.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fluxvla_core.contracts.reporter import Reporter, SilentReporter
from fluxvla_core.errors import ConfigError, RunFailed, UsageError
from fluxvla_core.evaluate.pool import run_jobs

if TYPE_CHECKING:
    from fluxvla_sim.aloha.demonstrations import Demonstration

SETTINGS = "collection.json"
SPARE_SEEDS = 4
SPARE_STRIDE = 1_000_000_000
"""Spare seeds lie this far apart: no other episode uses them, and all are below 2**32."""


@dataclass(frozen=True)
class Collection:
    """What a dataset follows from.

    Args:
        episodes: how many demonstrations; tasks take turns.
        tasks: names of the tasks.
        seed: of the first episode.
        fps: frames a second; must divide 50.
        camera_names, height, width: of the pictures.
        noise: see ``demonstrate``, in rad.
        quality: see ``fluxvla_sim.render``.

    Raises:
        ConfigError: a value is impossible.
    """

    episodes: int
    tasks: tuple[str, ...] = ("lift_hold", "transfer_cube")
    seed: int = 10_000
    fps: float = 10.0
    camera_names: tuple[str, ...] = ("top",)
    height: int = 144
    width: int = 192
    noise: float = 0.0
    quality: str = "cheap"

    def __post_init__(self) -> None:
        from fluxvla_sim.aloha.demonstrations import frame_stride
        from fluxvla_sim.aloha.tasks import get_task
        from fluxvla_sim.operators import AlohaSimOperator

        for task in self.tasks:
            get_task(task)
        # The operator's constructor has the checks of cameras, sizes and quality.
        size = self.height, self.width
        AlohaSimOperator("transfer_cube", 0, self.camera_names, *size, quality=self.quality)
        try:
            frame_stride(self.fps)
        except ValueError as error:
            raise ConfigError(str(error)) from error
        if self.episodes < 1 or not self.tasks:
            raise ConfigError(f"nothing to collect: {self.episodes} episodes of {self.tasks}")
        if not 0 <= self.seed <= SPARE_STRIDE - self.episodes:
            raise ConfigError(f"seed must be from 0 to {SPARE_STRIDE - self.episodes}")
        if not 0 <= self.noise <= 0.2:
            raise ConfigError(f"noise must be from 0 to 0.2 rad, got {self.noise}")


def collect(
    out: str | Path,
    collection: Collection,
    workers: int = 2,
    resume: bool = False,
    reporter: Reporter | None = None,
) -> dict[str, Any]:
    """Collect demonstrations into the dataset ``out``.

    Args:
        out: the dataset's folder; it must not exist yet.
        workers: processes that simulate, beside this one, which writes.
        resume: go on with a collection into ``out`` that was interrupted.

    Returns:
        JSON values: ``episodes``, ``frames``, ``retried``, ``seconds``, ``steps_per_s`` (control
        steps simulated a second), ``workers``.

    Raises:
        DataError: there is a dataset already.
        UsageError: there is an interrupted collection, or it had other settings.
        RunFailed: the expert fails too often, workers cannot be started, or the disk is full.
    """
    from fluxvla_aloha.embodiment import aloha_spec

    from fluxvla_core.data.writer import LeRobotWriter, staging_of
    from fluxvla_core.spec.embodiment import Camera
    from fluxvla_sim.aloha.scene import CONTROL_HZ
    from fluxvla_sim.aloha.tasks import MAX_STEPS, get_task

    reporter = reporter or SilentReporter()
    size = collection.height, collection.width
    cameras = tuple(Camera(name, *size) for name in collection.camera_names)
    note = staging_of(Path(out)) / SETTINGS
    if resume:
        _check_same(note, collection)
    elif note.parent.exists():
        raise UsageError(
            f"a collection into {out} was interrupted, or is under way",
            next=f"add --resume to go on with it, or delete {note.parent}",
        )
    began, retried, frames, kept = time.monotonic(), 0, 0, 0
    with LeRobotWriter(
        out, collection.fps, aloha_spec(cameras, CONTROL_HZ), recover=resume
    ) as writer:
        note.write_text(json.dumps(asdict(collection)))
        kept = writer.episodes
        jobs = range(kept, collection.episodes)
        work = partial(_Demonstrator, collection, cameras)
        with closing(run_jobs(work, jobs, workers)) as outcomes:
            for episode, found in _in_order(outcomes, jobs):
                task = get_task(task_name(collection, episode))
                _save(writer, found, task.instruction, episode)
                retried += found.seed != collection.seed + episode
                frames += len(found.states)
                pace = (episode + 1 - kept) / (time.monotonic() - began)
                reporter.progress(
                    "demonstrations", episode + 1, collection.episodes, per_s=round(pace, 2)
                )
    seconds = time.monotonic() - began
    simulated = (collection.episodes - kept + retried) * MAX_STEPS
    result = {
        "episodes": collection.episodes,
        "frames": frames,
        "retried": retried,
        "seconds": seconds,
        "steps_per_s": simulated / max(seconds, 1e-9),
        "workers": workers,
    }
    reporter.event("collected", **result)
    reporter.artifact("dataset", Path(out))
    return result


def task_name(collection: Collection, episode: int) -> str:
    """The task of an episode: they take turns."""
    return collection.tasks[episode % len(collection.tasks)]


class _Demonstrator:
    """A worker: acts out one episode, with spare seeds where the expert fails."""

    def __init__(self, collection: Collection, cameras: Sequence[Any]) -> None:
        from fluxvla_sim.aloha.expert import Expert
        from fluxvla_sim.aloha.scene import AlohaScene

        self._collection = collection
        self._cameras = cameras
        size = max(480, collection.height), max(640, collection.width)
        self._scene = AlohaScene(collection.quality, *size)
        self._expert = Expert(self._scene.model)

    def __call__(self, episode: int) -> Demonstration:
        from fluxvla_sim.aloha.demonstrations import demonstrate
        from fluxvla_sim.aloha.tasks import get_task

        name = task_name(self._collection, episode)
        first = self._collection.seed + episode
        for seed in (first + spare * SPARE_STRIDE for spare in range(SPARE_SEEDS)):
            found = demonstrate(
                self._scene,
                self._expert,
                get_task(name),
                seed,
                self._cameras,
                self._collection.fps,
                self._collection.noise,
            )
            if found is not None:
                return found
        raise RunFailed(
            f"the expert failed {name} with {SPARE_SEEDS} seeds in a row, from {first} on",
            cause=f"noise = {self._collection.noise:g} rad is too much for it",
            next="collect with less noise",
        )


def _in_order(outcomes: Any, jobs: Sequence[int]) -> Any:
    """``(episode, demonstration)`` in the order of the episodes; early ones wait."""
    early: dict[int, Any] = {}
    following = 0
    for outcome in outcomes:
        if outcome.error is not None:
            raise RunFailed(f"episode {jobs[outcome.index]} failed: {outcome.error}")
        early[outcome.index] = outcome.result
        while following in early:
            yield jobs[following], early.pop(following)
            following += 1


def _save(writer: Any, found: Demonstration, instruction: str, episode: int) -> None:
    for frame in range(len(found.states)):
        images = {name: pictures[frame] for name, pictures in found.images.items()}
        writer.add_frame(images, found.states[frame], found.actions[frame], instruction)
    writer.save_episode(key=episode)


def _check_same(note: Path, collection: Collection) -> None:
    if not note.exists():
        return
    before, now = json.loads(note.read_text()), json.loads(json.dumps(asdict(collection)))
    other = [f"{k}: {before.get(k)} / {now[k]}" for k in now if before.get(k) != now[k]]
    if other:
        raise UsageError(
            f"the interrupted collection had other settings: {'; '.join(other)}",
            next=f"use the same settings, or delete {note.parent} and begin anew",
        )
