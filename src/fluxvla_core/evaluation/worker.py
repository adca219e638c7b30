"""Episodes in worker processes: ``EpisodeWorker`` runs one, ``run_in_pool`` those that are missing.

A worker makes its environment and its policies once. The result of an episode follows from its key
alone; then neither the number of workers nor an interruption changes anything but the time it
takes.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from fluxvla_core.build import build_environment_from_cfg
from fluxvla_core.contracts.environment import Environment
from fluxvla_core.contracts.policy import Actor
from fluxvla_core.contracts.runner import Reporter
from fluxvla_core.errors import ConfigError
from fluxvla_core.evaluation.episodes import (
    DONE,
    ERROR,
    POLICY,
    SWAPPED,
    EpisodeKey,
    EvalLog,
    reason,
)
from fluxvla_core.evaluation.live import LiveSettings, run_live
from fluxvla_core.evaluation.policies import PolicySource, make_policy, match_policy
from fluxvla_core.evaluation.policy_server import PolicyFacts, ServedPolicy
from fluxvla_core.evaluation.pool import Outcome, WorkerPool
from fluxvla_core.evaluation.rollout import RolloutSettings, run_episode
from fluxvla_core.evaluation.videos import VideoRecorder, VideoSettings
from fluxvla_core.spec import Camera


@dataclass(frozen=True)
class Job:
    """One episode, and where its video goes; no video by default."""

    key: EpisodeKey
    video: str | None = None


@dataclass(frozen=True)
class Settings:
    """Settings of the worker processes; every outcome follows from them and the episode's key.

    Args:
        environment: the table of a registered environment.
        tasks: names of the tasks that are evaluated; a wrong instruction is of one of them if
            possible.
        sources: where the policy of ``policy`` and that of ``untrained`` come from.
        rollout: how episodes are run; its cameras are filled in for each policy.
        size: height and width of the policy's images; as it was trained by default.
        served: attributes of the policies that the parent serves, by group.
        live: on the wall clock instead of stepped.
    """

    environment: Mapping[str, Any]
    tasks: tuple[str, ...]
    sources: Mapping[str, PolicySource]
    rollout: RolloutSettings
    size: tuple[int, int] | None = None
    video: VideoSettings = field(default_factory=VideoSettings)
    served: Mapping[str, PolicyFacts] = field(default_factory=dict)
    live: LiveSettings | None = None


class EpisodeWorker:
    """Runs episodes in a worker process: a function from a job to the record of its episode.

    Environment and policy are made at once, the untrained baseline when it is first needed; all
    are kept.

    Args:
        link: to a ``PolicyServer``, where there are served policies.

    Raises:
        SpecMismatch: the policy is for another robot, or wants cameras that are not there.
        FluxError: the environment cannot be built, or the policy not be loaded.
    """

    def __init__(self, settings: Settings, link: Connection | None = None) -> None:
        self._settings = settings
        self._link = link
        self.environment = Environment.adapt(build_environment_from_cfg(settings.environment))
        self._actors: dict[str, tuple[Actor, tuple[Camera, ...]]] = {}
        # Before the first episode: one that does not fit is refused before a scene is built, and
        # loading it is not part of an episode's time.
        self.actor(POLICY)

    def __call__(self, job: Job | EpisodeKey) -> dict[str, Any]:
        """The record of an episode: JSON values.

        Raises:
            SpecMismatch: a policy is for another robot, or wants cameras that are not there.
            FluxError: a policy cannot be loaded, or answers something impossible.
        """
        if isinstance(job, EpisodeKey):
            job = Job(job)
        settings, key = self._settings, job.key
        actor, cameras = self.actor(key.group)
        spec = self.environment.spec
        if settings.live is not None:
            return self._live(settings.live, key, actor, cameras)
        instruction_of = None
        if key.group == SWAPPED:
            instruction_of = spec.task(swapped_task(self.environment, key.task, settings.tasks))
        video = None if job.video is None else VideoRecorder(Path(job.video), settings.video)
        try:
            record = run_episode(
                self.environment,
                actor,
                spec.task(key.task),
                key.seed,
                replace(settings.rollout, cameras=cameras),
                instruction_of,
                video,
            )
        finally:
            if video is not None:
                video.close()
        return self._completed(record, cameras)

    def _live(
        self, live: LiveSettings, key: EpisodeKey, actor: Actor, cameras: tuple[Camera, ...]
    ) -> dict[str, Any]:
        task, rollout = self.environment.spec.task(key.task), self._settings.rollout
        record = run_live(
            f"{key.group}-{key.task}-{key.seed}",
            self.environment,
            actor,
            task,
            key.seed,
            rollout.policy_seed + key.seed,
            cameras,
            rollout.max_steps or task.max_steps,
            live,
        )
        return self._completed(record, cameras)

    def _completed(self, record: dict[str, Any], cameras: tuple[Camera, ...]) -> dict[str, Any]:
        record["timing"]["memory_mb"] = memory_mb()
        if cameras:
            sizes = {camera.name: [camera.height, camera.width] for camera in cameras}
            record["images"] = {"sizes": sizes, "by": self.environment.drawn_by()}
        return record

    def actor(self, group: str) -> tuple[Actor, tuple[Camera, ...]]:
        """A group's policy and the cameras that it looks at."""
        name = group if group in self._settings.sources else POLICY
        if name not in self._actors:
            actor: Actor
            if name in self._settings.served and self._link is not None:
                actor = ServedPolicy(self._link, name, self._settings.served[name])
            else:
                actor = make_policy(self._settings.sources[name])
            cameras = match_policy(actor, self.environment.spec, self._settings.size)
            self._actors[name] = actor, cameras
        return self._actors[name]


def run_in_pool(
    pool: WorkerPool, keys: Sequence[EpisodeKey], log: EvalLog, reporter: Reporter
) -> list[dict[str, Any]]:
    """Run the episodes of ``keys`` that ``log`` does not have yet.

    Args:
        pool: its factory makes, in a worker process, a function from a key to a result: JSON
            values with at least ``success`` (bool) and ``steps`` (int).

    Returns:
        One record for each key, in their order: the result with ``group``, ``task``, ``seed``,
        ``attempts``, and ``status``, which is ``done``, or ``error`` with the reason in ``error``.

    Raises:
        RunFailed: workers cannot be started, or results cannot be kept.
        FluxError: one that means bad input, from a worker.
        KeyboardInterrupt: after the workers have been ended; finished episodes are kept.
    """
    missing = [key for key in keys if key not in log]
    errors: dict[EpisodeKey, dict[str, Any]] = {}
    done, began = len(keys) - len(missing), time.monotonic()
    succeeded = sum(bool(record["success"]) for record in log.records(keys))
    if done and missing:
        reporter.info(f"{done} of {len(keys)} episodes are there already; running the others")
    with closing(pool.run(missing)) as outcomes:
        for outcome in outcomes:
            key = missing[outcome.index]
            record = _record(key, outcome)
            log.add(record)
            if record["status"] == ERROR:
                errors[key] = record
                reporter.warn(_error_line(record))
            done += 1
            succeeded += bool(record.get("success"))
            reporter.event("episode", **record)
            pace = 60 * (done - len(keys) + len(missing)) / (time.monotonic() - began)
            reporter.progress(
                "episodes", done, len(keys), successes=succeeded, per_minute=round(pace, 1)
            )
    return [errors[key] if key in errors else log.records([key])[0] for key in keys]


def _record(key: EpisodeKey, outcome: Outcome) -> dict[str, Any]:
    head = {"group": key.group, "task": key.task, "seed": key.seed}
    if outcome.error is not None:
        tail: dict[str, Any] = {"status": ERROR, "error": outcome.error}
    else:
        tail = {"status": DONE, **outcome.result}
    return {**head, **tail, "attempts": outcome.attempts}


def _error_line(record: dict[str, Any]) -> str:
    return (
        f"episode {record['group']}/{record['task']}/{record['seed']} gave no result "
        f"after {record['attempts']} attempts: {reason(record['error'])}"
    )


def swapped_task(environment: Environment, task: str, evaluated: Sequence[str]) -> str:
    """The task whose instruction the policy gets instead of that of ``task``.

    It is the next one, cyclically, that could be done in the same scene, and one of ``evaluated``
    if possible.

    Raises:
        ConfigError: the environment's scenes allow no other task.
    """
    names: list[str] = [each.name for each in environment.spec.tasks]
    others = list(environment.other_tasks(task))
    others = [name for name in others if name in evaluated] or others
    if not others:
        raise ConfigError(
            f"instruction_swap: no other task of {environment.spec.name} can be done in the scene "
            f"of {task!r}",
            next="evaluate without it: --set <section>.instruction_swap=false",
        )
    here = names.index(task)
    return min(others, key=lambda name: (names.index(name) <= here, names.index(name)))


def memory_mb() -> float:
    """The most memory that this process ever had (resident), in MiB; 0 if unknown."""
    status = Path("/proc/self/status")
    if status.exists():
        # Not getrusage: on Linux a new process begins with the peak of the one that started it.
        lines = status.read_text(encoding="utf-8").splitlines()
        peaks = [line.split()[1] for line in lines if line.startswith("VmHWM:")]
        return round(int(peaks[0]) / 1024, 1) if peaks else 0.0
    try:
        import resource
    except ImportError:  # Windows
        return 0.0
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(most / (1024 * 1024 if sys.platform == "darwin" else 1024), 1)
