"""Demonstrations of a policy, a scripted expert as a rule, in any environment.

Episode ``k`` is acted out with seed ``seed + k``; where the expert fails, with the next of that
episode's own spare seeds. What it shows follows from ``k`` alone, so the dataset is the same for
any number of workers, and a collection that was interrupted can go on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.build import build_environment_from_cfg, build_policy_from_cfg
from fluxvla_core.contracts.environment import Actor, Environment, EnvironmentSpec, TaskSpec
from fluxvla_core.contracts.reporter import Reporter, SilentReporter
from fluxvla_core.errors import ConfigError, RunFailed
from fluxvla_core.evaluate.collecting import Recorded, collect_episodes
from fluxvla_core.evaluate.policies import fit, resolve_name
from fluxvla_core.evaluate.rollout import Commands, shaped
from fluxvla_core.evaluate.worker import choose_tasks
from fluxvla_core.safety.trips import not_finite
from fluxvla_core.spec.embodiment import Camera

SPARE_SEEDS = 6
SPARE_STRIDE = 500_000_000
"""Spare seeds lie this far apart: no other episode uses them, and all are below 2**32."""


@dataclass(frozen=True)
class Collection:
    """What a dataset follows from.

    Args:
        environment: the table of a registered environment.
        policy: the table of a registered policy, ``expert`` for the environment's own, or
            ``random``.
        episodes: how many demonstrations; tasks take turns, or follow each other where going from
            one to another takes long.
        tasks: names; all of the environment's by default.
        seed: of the first episode.
        cameras: names; all of the environment's by default.
        height, width: of all pictures; each camera's own by default.
        failures: also keep episodes in which the task was not done.

    Raises:
        ConfigError: a value is impossible.
    """

    environment: Mapping[str, Any]
    episodes: int
    policy: str | Mapping[str, Any] = "expert"
    tasks: tuple[str, ...] | None = None
    seed: int = 10_000
    cameras: tuple[str, ...] | None = None
    height: int | None = None
    width: int | None = None
    failures: bool = False

    def __post_init__(self) -> None:
        if self.episodes < 1:
            raise ConfigError(f"nothing to collect: {self.episodes} episodes")
        if not 0 <= self.seed <= SPARE_STRIDE - self.episodes:
            raise ConfigError(f"seed must be from 0 to {SPARE_STRIDE - self.episodes}")
        for name, value in (("height", self.height), ("width", self.width)):
            if value is not None and value < 16:
                raise ConfigError(f"{name}: pictures of {value} pixels are too small")


def collect(
    out: str | Path,
    collection: Collection,
    workers: int = 2,
    resume: bool = False,
    reporter: Reporter | None = None,
) -> dict[str, Any]:
    """Collect demonstrations into the LeRobot v3.0 dataset ``out``; see ``collect_episodes``.

    Raises:
        ConfigError, PluginError, SpecMismatch: environment, policy, tasks or cameras do not fit.
        DataError: there is a dataset already.
        UsageError: there is an interrupted collection, or it had other settings.
        RunFailed: the expert fails too often, workers cannot be started, or the disk is full.
    """
    environment = build_environment_from_cfg(collection.environment)
    spec: EnvironmentSpec = environment.spec
    actor = _actor(collection, environment)
    environment.close()
    choose_tasks(spec.tasks, collection.tasks)
    fit(actor, spec)
    cameras = _cameras(collection, spec)
    fps = spec.embodiment.rate_hz / frame_stride(actor, spec)
    return collect_episodes(
        Path(out),
        fps,
        replace(spec.embodiment, cameras=cameras),
        partial(Demonstrator, collection),
        collection.episodes,
        {**asdict(collection), "details": dict(spec.details)},
        workers,
        resume,
        reporter or SilentReporter(),
    )


class Demonstrator:
    """A worker: acts out the episode of a number, with spare seeds where the expert fails."""

    def __init__(self, collection: Collection) -> None:
        self._collection = collection
        self._environment: Environment = build_environment_from_cfg(collection.environment)
        self._spec = self._environment.spec
        self._actor = _actor(collection, self._environment)
        self._tasks = choose_tasks(self._spec.tasks, collection.tasks)
        self._cameras = _cameras(collection, self._spec)

    def __call__(self, episode: int) -> Recorded:
        """The episode.

        Raises:
            RunFailed: the expert failed with every seed.
        """
        collection = self._collection
        task = task_of(episode, collection.episodes, self._tasks, self._spec.keep_together)
        first = collection.seed + episode
        for spare in range(SPARE_SEEDS):
            seed = first + spare * SPARE_STRIDE
            found, success = demonstrate(self._environment, self._actor, task, seed, self._cameras)
            if success or collection.failures:
                return replace(found, retried=spare)
        raise RunFailed(
            f"the expert failed {task.name} with {SPARE_SEEDS} seeds in a row, from {first} on",
            cause="noise is too much for it, or the task is",
            next="collect with less noise, or other tasks",
        )


def demonstrate(
    environment: Environment, actor: Actor, task: TaskSpec, seed: int, cameras: Sequence[Camera]
) -> tuple[Recorded, bool]:
    """Act out ``task`` and record its first ``record_steps`` steps.

    A frame is what is seen before its steps; its action is what the actor wants to have reached at
    the next frame: the first action of its chunk. What is executed on the way there is the actor's
    ``executed``, or leads straight to it. So noise can be in what is done and not in what is
    taught, which leads back (Laskey et al., "DART", CoRL 2017).

    Returns:
        The episode, and whether the task was done, judged over all of it.

    Raises:
        SpecMismatch: the actor's chunk is of another shape.
        RunFailed: it is not finite.
    """
    spec = environment.spec
    environment.reset(seed, task.name)
    if hasattr(actor, "enter"):
        actor.enter(environment)
    actor.reset(seed)
    commands = Commands(spec, getattr(actor, "action_rate_hz", None))
    commands.start(environment.state)
    images: dict[str, list[npt.NDArray[np.uint8]]] = {camera.name: [] for camera in cameras}
    states, actions = [], []
    recorded = task.max_steps if task.record_steps is None else task.record_steps
    steps, success, ended = 0, False, False
    while not ended and steps < task.max_steps:
        teaches = steps < recorded
        observation = environment.observe(cameras if teaches else ())
        chunk = _checked(actor.predict_action(observation), spec)
        if teaches:
            for name, pictures in images.items():
                pictures.append(observation["images"][name])
            states.append(np.array(environment.state))
            actions.append(chunk[0].copy())
        own = getattr(actor, "executed", None)
        targets = commands.of(chunk[:1]) if own is None else _checked(own, spec)
        for target in targets:
            found = environment.step(commands.take(target))
            steps += 1
            success, ended = bool(found.success), bool(found.ended)
            if ended or steps >= task.max_steps:
                break
    stacked = {name: np.stack(pictures) for name, pictures in images.items()}
    return Recorded(stacked, np.stack(states), np.stack(actions), task.instruction), success


def frame_stride(actor: Any, spec: EnvironmentSpec) -> int:
    """Control steps from frame to frame: a frame is an action of the actor.

    Raises:
        ConfigError: the actor's rate does not divide the environment's.
    """
    rate = float(getattr(actor, "action_rate_hz", spec.embodiment.rate_hz))
    stride = round(spec.embodiment.rate_hz / rate) if rate > 0 else 0
    if stride < 1 or abs(stride * rate - spec.embodiment.rate_hz) > 1e-9 * rate:
        raise ConfigError(
            f"the policy's {rate:g} actions a second do not divide {spec.name}'s "
            f"{spec.embodiment.rate_hz:g} steps"
        )
    return stride


def task_of(episode: int, episodes: int, tasks: Sequence[TaskSpec], together: bool) -> TaskSpec:
    """The task of an episode: they take turns, or follow each other."""
    if together:
        return tasks[episode * len(tasks) // episodes]
    return tasks[episode % len(tasks)]


def _checked(chunk: Any, spec: EnvironmentSpec) -> npt.NDArray[np.float64]:
    """Nothing can be learned from a chunk that is not finite."""
    array = shaped(chunk, spec.embodiment.dim)
    problem = not_finite(array, spec.embodiment.joint_names)
    if problem is not None:
        raise RunFailed(problem)
    return array


def _actor(collection: Collection, environment: Environment) -> Actor:
    what = resolve_name(collection.policy, environment)
    if isinstance(what, str):
        raise ConfigError(
            f"policy {what!r} demonstrates nothing: its actions are what was learned",
            next="evaluate it: fluxvla run --section eval",
        )
    made: Actor = build_policy_from_cfg(what)
    return made


def _cameras(collection: Collection, spec: EnvironmentSpec) -> tuple[Camera, ...]:
    known = {camera.name: camera for camera in spec.embodiment.cameras}
    names = tuple(known) if collection.cameras is None else collection.cameras
    for name in names:
        if name not in known:
            raise ConfigError(
                f"{spec.name} has no camera {name!r}; it has {', '.join(known) or 'none'}"
            )
    return tuple(
        replace(
            known[name],
            height=collection.height or known[name].height,
            width=collection.width or known[name].width,
        )
        for name in names
    )
