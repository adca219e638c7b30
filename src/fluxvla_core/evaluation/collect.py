"""Collect demonstrations of a policy, usually a scripted expert, in any environment.

Episode ``k`` is run with seed ``seed + k``; where the expert fails, or the simulation diverges,
with the next of that episode's own spare seeds. Its content follows from ``k`` alone, so the
dataset is the same for any number of workers, and an interrupted collection can be continued.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.build import build_environment_from_cfg, build_policy_from_cfg
from fluxvla_core.contracts.environment import Environment, EnvironmentSpec, TaskSpec
from fluxvla_core.contracts.policy import Actor
from fluxvla_core.contracts.runner import Reporter, SilentReporter
from fluxvla_core.control.chunks import not_finite
from fluxvla_core.errors import ConfigError, DataError, RunFailed, UsageError
from fluxvla_core.evaluation.policies import match_policy, resolve_policy
from fluxvla_core.evaluation.pool import Outcome, WorkerPool
from fluxvla_core.evaluation.stepping import ChunkCommands, Diverged, check_step, shaped
from fluxvla_core.spec import Camera, EmbodimentSpec
from fluxvla_core.untrusted import read_json

META, SETTINGS = "meta", "collection.json"
_GO_ON = "run the same command with --resume"


SPARE_SEEDS = 6
SPARE_STRIDE = 500_000_000
"""Spare seeds lie this far apart: no other episode uses them, and all are below 2**32."""


@dataclass(frozen=True)
class Collection:
    """Settings of a collection, from which its dataset follows.

    Args:
        environment: the table of a registered environment.
        policy: the table of a registered policy, ``expert`` for the environment's own, or
            ``random``.
        episodes: how many demonstrations; tasks take turns, or follow each other where going from
            one to another takes long.
        tasks: names; all of the environment's by default.
        seed: seed of the first episode.
        cameras: names; all of the environment's by default.
        height, width: size of all images; each camera's own by default.
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
                raise ConfigError(f"{name}: images of {value} pixels are too small")


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
    environment = Environment.adapt(build_environment_from_cfg(collection.environment))
    spec: EnvironmentSpec = environment.spec
    actor = _actor(collection, environment)
    environment.close()
    spec.select_tasks(collection.tasks)
    match_policy(actor, spec)
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
    """A worker: runs the episode of a number, with spare seeds where the expert fails."""

    def __init__(self, collection: Collection) -> None:
        self._collection = collection
        self._environment = Environment.adapt(build_environment_from_cfg(collection.environment))
        self._spec = self._environment.spec
        self._actor = _actor(collection, self._environment)
        self._tasks = self._spec.select_tasks(collection.tasks)
        self._cameras = _cameras(collection, self._spec)

    def __call__(self, episode: int) -> Demonstration:
        """The episode.

        Raises:
            RunFailed: the expert failed with every seed.
        """
        collection = self._collection
        task = task_of(episode, collection.episodes, self._tasks, self._spec.keep_together)
        first, diverged = collection.seed + episode, ""
        for spare in range(SPARE_SEEDS):
            seed = first + spare * SPARE_STRIDE
            try:
                found, success = demonstrate(
                    self._environment, self._actor, task, seed, self._cameras
                )
            except Diverged as error:  # teaches nothing, not even how to fail
                diverged = f"; the last simulation that diverged: {error.what}"
                continue
            if success or collection.failures:
                return replace(found, retried=spare)
        raise RunFailed(
            f"the expert failed {task.name} with {SPARE_SEEDS} seeds in a row, from {first} on"
            f"{diverged}",
            cause="noise is too much for it, or the task is",
            next="collect with less noise, or other tasks",
        )


def demonstrate(
    environment: Environment, actor: Actor, task: TaskSpec, seed: int, cameras: Sequence[Camera]
) -> tuple[Demonstration, bool]:
    """Run an episode of ``task`` and record its first ``record_steps`` steps.

    A frame is the observation before its steps; its action is the actor's target for the next
    frame: the first action of its chunk. The commands on the way there are the actor's
    ``executed``, or a straight line. So noise can be in the executed commands and not in the
    recorded actions, which lead back (Laskey et al., "DART", CoRL 2017).

    Returns:
        The episode, and whether the task was done at its end.

    Raises:
        SpecMismatch: the actor's chunk is of another shape.
        RunFailed: it is not finite.
        Diverged: the simulation diverged.
    """
    environment, actor = Environment.adapt(environment), Actor.adapt(actor)
    spec = environment.spec
    environment.reset(seed, task.name)
    actor.enter(environment)
    actor.reset(seed)
    commands = ChunkCommands(spec, actor.action_rate_hz)
    commands.start(environment.state)
    images: dict[str, list[npt.NDArray[np.uint8]]] = {camera.name: [] for camera in cameras}
    states, actions = [], []
    if actor.n_obs_steps > 1:
        raise ConfigError(
            f"{type(actor).__name__} acts on {actor.n_obs_steps} observations (n_obs_steps); a "
            "collection asks with the present one alone",
            next="demonstrate with an expert; evaluate such a policy: fluxvla run --section eval",
        )
    recorded = task.max_steps if task.record_steps is None else task.record_steps
    steps, success, ended, instruction = 0, False, False, task.instruction
    while not ended and steps < task.max_steps:
        teaches = steps < recorded
        observation = environment.observe(cameras if teaches else ())
        chunk = _checked(actor.predict_action(observation), spec)
        if teaches:
            for name, collected in images.items():
                collected.append(observation["images"][name])
            instruction = observation["task_description"]
            states.append(np.array(environment.state))
            actions.append(chunk[0].copy())
        own = actor.executed
        targets = commands.targets(chunk[:1]) if own is None else _checked(own, spec)
        for target in targets:
            found = environment.step(commands.command(target))
            steps += 1
            check_step(environment, steps)
            success, ended = bool(found.success), bool(found.ended)
            if ended or steps >= task.max_steps:
                break
    stacked = {name: np.stack(collected) for name, collected in images.items()}
    return Demonstration(stacked, np.stack(states), np.stack(actions), instruction), success


def frame_stride(actor: Actor, spec: EnvironmentSpec) -> int:
    """Control steps from one frame to the next; there is one frame for each of the actor's actions.

    Raises:
        ConfigError: the actor's rate does not divide the environment's.
    """
    own = actor.action_rate_hz
    rate = float(spec.embodiment.rate_hz if own is None else own)
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
    """``chunk`` as ``(T, dim)`` float64, checked to be finite."""
    array = shaped(chunk, spec.embodiment.dim)
    problem = not_finite(array, spec.embodiment.joint_names)
    if problem is not None:
        raise RunFailed(problem)
    return array


def _actor(collection: Collection, environment: Environment) -> Actor:
    policy = resolve_policy(collection.policy, environment)
    if isinstance(policy, str):
        raise ConfigError(
            f"policy {policy!r} demonstrates nothing: its actions are what was learned",
            next="evaluate it: fluxvla run --section eval",
        )
    return Actor.adapt(build_policy_from_cfg(policy))


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


@dataclass(frozen=True)
class Demonstration:
    """One recorded episode.

    Args:
        images: camera name -> ``(N, H, W, 3)`` uint8.
        states: ``(N, S)``; actions: ``(N, D)``, in the embodiment's units.
        instruction: the language instruction of the task.
        retried: how many attempts failed before.
    """

    images: Mapping[str, npt.NDArray[np.uint8]]
    states: npt.NDArray[np.float64]
    actions: npt.NDArray[np.float64]
    instruction: str
    retried: int = 0


def collect_episodes(
    out: Path,
    fps: float,
    embodiment: EmbodimentSpec,
    factory: Callable[[], Callable[[int], Demonstration]],
    episodes: int,
    settings: Mapping[str, Any],
    workers: int,
    resume: bool,
    reporter: Reporter,
) -> dict[str, Any]:
    """Collect ``episodes`` episodes into the dataset ``out``.

    Args:
        out: the dataset's folder; it must not exist yet.
        fps: frames a second.
        factory: makes, in a worker process, a function from an episode's number to the episode.
        settings: what the dataset follows from, as JSON values; continuing with other ones is
            refused.
        workers: processes that act; this one writes.
        resume: continue a collection into ``out`` that was interrupted.

    Returns:
        JSON values: ``episodes``; ``collected``, ``frames`` and ``retried`` of this call;
        ``seconds``, ``frames_per_s``, ``workers``.

    Raises:
        DataError: there is a dataset already.
        UsageError: there is an interrupted collection, or it had other settings.
        RunFailed: an episode fails, workers cannot be started, or the disk is full.
    """
    from fluxvla_core.data.files import explain_disk, staging_of, write_metadata
    from fluxvla_core.data.writer import LeRobotWriter

    note = staging_of(out) / SETTINGS
    if resume:
        _check_same(note, settings)
    elif note.parent.exists():
        raise UsageError(
            f"a collection into {out} was interrupted, or is under way",
            next=f"add --resume to continue it, or delete {note.parent}",
        )
    began, retried, frames = time.monotonic(), 0, 0
    with LeRobotWriter(out, fps, embodiment, recover=resume, go_on=_GO_ON) as writer:
        try:
            write_metadata(note, dict(settings))
        except OSError as error:
            next = f"make room, then {_GO_ON}"
            raise explain_disk(error, out, "no episode was lost", next) from error
        saved = writer.episodes
        jobs = range(saved, episodes)
        with WorkerPool(factory, workers) as pool:
            for number, outcome in _in_order(pool.run(jobs), jobs):
                for frame in range(len(outcome.states)):
                    shown = {name: stack[frame] for name, stack in outcome.images.items()}
                    writer.add_frame(
                        shown,
                        outcome.states[frame],
                        outcome.actions[frame],
                        outcome.instruction,
                    )
                writer.save_episode(key=number)
                retried += outcome.retried
                frames += len(outcome.states)
                pace = (number + 1 - saved) / (time.monotonic() - began)
                reporter.progress("demonstrations", number + 1, episodes, per_s=round(pace, 2))
    # It stays with the dataset, so that an evaluation knows the seeds of the training data.
    write_metadata(out / META / SETTINGS, dict(settings))
    seconds = time.monotonic() - began
    result = {
        "episodes": episodes,
        "collected": episodes - saved,
        "frames": frames,
        "retried": retried,
        "seconds": seconds,
        "frames_per_s": frames / max(seconds, 1e-9),
        "workers": workers,
    }
    reporter.event("collected", **result)
    reporter.artifact("dataset", out)
    return result


def _in_order(
    outcomes: Iterator[Outcome], jobs: Sequence[int]
) -> Iterator[tuple[int, Demonstration]]:
    """Episodes in the order of their numbers; early ones wait."""
    early: dict[int, Demonstration] = {}
    following = 0
    for outcome in outcomes:
        if outcome.error is not None:
            raise RunFailed(f"episode {jobs[outcome.index]} failed: {outcome.error}")
        early[outcome.index] = outcome.result
        while following in early:
            yield jobs[following], early.pop(following)
            following += 1


def _check_same(note: Path, settings: Mapping[str, Any]) -> None:
    if not note.exists():
        return
    before = read_json(note, dict[str, Any], DataError)
    now = json.loads(json.dumps(dict(settings)))
    other = [f"{k}: {before.get(k)} / {now[k]}" for k in now if before.get(k) != now[k]]
    if other:
        raise UsageError(
            f"the interrupted collection had other settings: {'; '.join(other)}",
            next=f"use the same settings, or delete {note.parent} and start again",
        )
