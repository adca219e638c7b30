"""Demonstrations in parallel, written as one LeRobot v3.0 dataset.

Episode ``k`` is acted out with seed ``seed + k``; where the expert fails, with the next of that
episode's own spare seeds. One process writes, in the order of the episodes. So the dataset is the
same for any number of workers, and a collection that was interrupted can go on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fluxvla_core.contracts.reporter import Reporter, SilentReporter
from fluxvla_core.errors import ConfigError, RunFailed

if TYPE_CHECKING:
    from fluxvla_core.evaluate.collecting import Recorded

SPARE_SEEDS = 4
SPARE_STRIDE = 1_000_000_000
"""Spare seeds lie this far apart: no other episode uses them, and all are below 2**32."""


@dataclass(frozen=True)
class Collection:
    """What a dataset follows from.

    Args:
        episodes: how many demonstrations; tasks take turns.
        robot: ``aloha`` or ``ur5e``.
        tasks: names of the robot's tasks.
        seed: of the first episode.
        fps: frames a second; must divide 50.
        camera_names, height, width: of the pictures.
        noise: see ``demonstrate``, in rad.
        render: see ``SimEnvironment``.

    Raises:
        ConfigError: a value is impossible.
    """

    episodes: int
    robot: str = "aloha"
    tasks: tuple[str, ...] = ("lift_hold", "transfer_cube")
    seed: int = 10_000
    fps: float = 10.0
    camera_names: tuple[str, ...] = ("top",)
    height: int = 144
    width: int = 192
    noise: float = 0.0
    render: str = "cheap"

    def __post_init__(self) -> None:
        from fluxvla_core.evaluate.drawing import check_render
        from fluxvla_sim.expert import frame_stride
        from fluxvla_sim.operators import sim_cameras
        from fluxvla_sim.robots import ROBOTS

        if self.robot not in ROBOTS:
            raise ConfigError(f"there is no robot {self.robot!r}; there are {', '.join(ROBOTS)}")
        robot = ROBOTS[self.robot]
        for task in self.tasks:
            robot.find(task)
        sim_cameras(robot, self.camera_names, self.height, self.width)
        check_render(self.render)
        frame_stride(self.fps)
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
        JSON values: those of ``collect_episodes``, and ``steps_per_s``, the control steps that
        were simulated a second.

    Raises:
        DataError: there is a dataset already.
        UsageError: there is an interrupted collection, or it had other settings.
        RunFailed: the expert fails too often, workers cannot be started, or the disk is full.
    """
    from fluxvla_core.evaluate.collecting import collect_episodes
    from fluxvla_sim.operators import sim_cameras
    from fluxvla_sim.robots import ROBOTS

    robot = ROBOTS[collection.robot]
    cameras = sim_cameras(robot, collection.camera_names, collection.height, collection.width)
    found = collect_episodes(
        Path(out),
        collection.fps,
        robot.embodiment(cameras),
        partial(_Demonstrator, collection, cameras),
        collection.episodes,
        asdict(collection),
        workers,
        resume,
        reporter or SilentReporter(),
    )
    # Each demonstration, also one that failed, is simulated to its end.
    most = max(robot.find(task)[0].max_steps for task in collection.tasks)
    simulated = (found["collected"] + found["retried"]) * most
    return {**found, "steps_per_s": simulated / max(found["seconds"], 1e-9)}


def task_name(collection: Collection, episode: int) -> str:
    """The task of an episode: they take turns."""
    return collection.tasks[episode % len(collection.tasks)]


class _Demonstrator:
    """A worker: acts out one episode, with spare seeds where the expert fails."""

    def __init__(self, collection: Collection, cameras: Sequence[Any]) -> None:
        self._collection = collection
        self._cameras = cameras
        # Task -> world, task, scene and expert; tasks of one world share the latter two.
        self._stages: dict[str, Any] = {}

    def __call__(self, episode: int) -> Recorded:
        from fluxvla_core.evaluate.collecting import Recorded
        from fluxvla_sim.demonstrations import demonstrate

        collection = self._collection
        name = task_name(collection, episode)
        world, task, scene, expert = self._stage(name)
        first = collection.seed + episode
        for spare in range(SPARE_SEEDS):
            found = demonstrate(
                world,
                scene,
                expert,
                task,
                first + spare * SPARE_STRIDE,
                self._cameras,
                collection.fps,
                collection.noise,
            )
            if found is not None:
                return Recorded(
                    found.images, found.states, found.actions, task.instruction, retried=spare
                )
        noisy = f"noise = {collection.noise:g} rad is too much for it"
        raise RunFailed(
            f"the expert failed {name} with {SPARE_SEEDS} seeds in a row, from {first} on",
            cause=noisy if collection.noise else None,
            next="collect with less noise" if collection.noise else "collect with another --seed",
        )

    def _stage(self, name: str) -> Any:
        from fluxvla_sim.robots import ROBOTS

        if name not in self._stages:
            collection = self._collection
            world, task = ROBOTS[collection.robot].find(name)
            known = next((s for s in self._stages.values() if s[0] is world), None)
            if known is not None:
                scene, expert = known[2:]
            else:
                scene = world.open_scene(collection.render)
                expert = world.open_expert(scene.model)
            self._stages[name] = world, task, scene, expert
        return self._stages[name]
