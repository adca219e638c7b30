"""Demonstrations of the scripted expert in LIBERO's scenes, as a LeRobot v3.0 dataset.

In libero_object the target always lies in the same place, so that a policy can do without
listening. ``mixed`` lets the expert also put the other tasks' objects into the basket wherever they
lie in a scene: then the instruction alone says which.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fluxvla_core.contracts.reporter import Reporter, SilentReporter
from fluxvla_core.errors import ConfigError, RunFailed
from fluxvla_core.evaluate.collecting import Recorded, collect_episodes
from fluxvla_core.evaluate.drawing import check_render
from fluxvla_core.spec.embodiment import Camera
from fluxvla_libero.embodiment import CONTROL_HZ, SCENE_CAMERAS, libero_spec
from fluxvla_libero.suites import SuiteTask, can_be_done_in, choose_tasks

if TYPE_CHECKING:
    from fluxvla_libero.scene import LiberoScene

SPARE_SEEDS = 6
SPARE_STRIDE = 500_000_000
"""Spare seeds lie this far apart: no other episode uses them, and all are below 2**32."""


@dataclass(frozen=True)
class Collection:
    """What a dataset follows from.

    Args:
        episodes: how many demonstrations, shared evenly between what is asked for in each scene.
        suite: whose scenes.
        tasks: of the suite, by index or name; all by default.
        mixed: also do each of these tasks in the scenes of the others, where it can be done.
        seed: of the first episode.
        camera_names: of the scene's two.
        height, width: of the pictures.
        noise: see ``demonstrate``.
        render: how pictures are drawn, see ``fluxvla_core.evaluate.drawing``.

    Raises:
        ConfigError: a value is impossible.
    """

    episodes: int
    suite: str = "libero_object"
    tasks: tuple[int | str, ...] | None = None
    mixed: bool = False
    seed: int = 10_000
    camera_names: tuple[str, ...] = SCENE_CAMERAS
    height: int = 224
    width: int = 224
    noise: float = 0.0
    render: str = "cheap"

    def __post_init__(self) -> None:
        unknown = [name for name in self.camera_names if name not in SCENE_CAMERAS]
        if unknown or not self.camera_names:
            raise ConfigError(
                f"cameras must be of {', '.join(SCENE_CAMERAS)}, got {list(self.camera_names)}"
            )
        check_render(self.render)
        if min(self.height, self.width) < 16:
            raise ConfigError(f"pictures of {self.height}x{self.width} are too small")
        if self.episodes < 1:
            raise ConfigError(f"episodes must be at least 1, got {self.episodes}")
        if not 0 <= self.seed <= SPARE_STRIDE - self.episodes:
            raise ConfigError(f"seed must be from 0 to {SPARE_STRIDE - self.episodes}")
        if not 0 <= self.noise <= 1:
            raise ConfigError(f"noise must be from 0 to 1, got {self.noise}")


def collect(
    out: str | Path,
    collection: Collection,
    workers: int = 2,
    resume: bool = False,
    reporter: Reporter | None = None,
) -> dict[str, Any]:
    """Collect demonstrations into the dataset ``out``; see ``collect_episodes``.

    Raises:
        MissingPlugin, RunFailed, ConfigError: LIBERO is missing, or the expert cannot do a task.
    """
    size = collection.height, collection.width
    cameras = tuple(Camera(name, *size) for name in collection.camera_names)
    pairs(collection)  # what is wrong with suite and tasks is said before a process starts
    return collect_episodes(
        Path(out),
        CONTROL_HZ,
        libero_spec(cameras),
        partial(_Demonstrator, collection, cameras),
        collection.episodes,
        asdict(collection),
        workers,
        resume,
        reporter or SilentReporter(),
    )


def pairs(collection: Collection) -> list[tuple[SuiteTask, SuiteTask]]:
    """``(scene, what is asked for)``, scene by scene."""
    tasks = choose_tasks(collection.suite, collection.tasks)
    if not collection.mixed:
        return [(task, task) for task in tasks]
    return [(scene, task) for scene in tasks for task in tasks if can_be_done_in(task, scene)]


class _Demonstrator:
    """A worker: acts out one episode, with spare seeds where the expert fails."""

    def __init__(self, collection: Collection, cameras: Sequence[Camera]) -> None:
        self._collection = collection
        self._cameras = cameras
        self._pairs = pairs(collection)
        self._scene: LiberoScene | None = None

    def __call__(self, episode: int) -> Recorded:
        from fluxvla_libero.demonstrations import demonstrate

        collection = self._collection
        # One scene after the other, because building one takes seconds.
        where, task = self._pairs[episode * len(self._pairs) // collection.episodes]
        scene = self._enter(where)
        first = collection.seed + episode
        for spare in range(SPARE_SEEDS):
            seed = first + spare * SPARE_STRIDE
            found = demonstrate(scene, task, seed, self._cameras, collection.noise)
            if found is not None:
                return Recorded(found.images, found.states, found.actions, task.language, spare)
        raise RunFailed(
            f"the expert failed {task.name} with {SPARE_SEEDS} seeds in a row, from {first} on",
            cause=f"noise = {collection.noise:g} is too much for it, or the task is",
            next="collect with less noise, or other tasks",
        )

    def _enter(self, task: SuiteTask) -> LiberoScene:
        from fluxvla_libero.scene import LiberoScene

        if self._scene is None or self._scene.task != task:
            if self._scene is not None:
                self._scene.close()
            self._scene = LiberoScene(task, self._collection.render)
        return self._scene
