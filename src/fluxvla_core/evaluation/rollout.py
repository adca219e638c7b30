"""Episodes in a worker process: observe, predict, execute some of the chunk, observe again.

A worker makes its environment and its policies once. The result of an episode follows from its key
alone; then neither the number of workers nor an interruption changes anything but the time it
takes.

Time stands still while the policy thinks. In an environment whose actions are joint targets the
commands are formed by the same path as on a robot: a chunk's actions are joined linearly from the
last command on and kept within the same limits. Other actions pass the limits unchanged.

A policy that acts on several observations also gets those of the action steps before: of every
action that is executed, as far back as it looks.
"""

from __future__ import annotations

import hashlib
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.build import build_environment_from_cfg
from fluxvla_core.contracts.contract import implements
from fluxvla_core.contracts.environment import Environment, TaskSpec
from fluxvla_core.contracts.frame import Observation
from fluxvla_core.contracts.policy import Actor, with_history
from fluxvla_core.control.chunks import not_finite
from fluxvla_core.errors import ConfigError
from fluxvla_core.evaluation.episodes import POLICY, SWAPPED, EpisodeKey
from fluxvla_core.evaluation.live import LiveSettings, run_live
from fluxvla_core.evaluation.policies import PolicySource, make_policy, match_policy
from fluxvla_core.evaluation.policy_server import PolicyFacts, ServedPolicy
from fluxvla_core.evaluation.stepping import (
    ChunkCommands,
    check_state,
    check_step,
    history_stride,
    shaped,
)
from fluxvla_core.evaluation.videos import VideoRecorder, VideoSettings
from fluxvla_core.spec import Camera

Array = npt.NDArray[np.float64]
OnStep = Callable[[Environment, int], None]


@dataclass(frozen=True)
class RolloutSettings:
    """Settings of an episode, besides its environment, policy, task and seed.

    Args:
        cameras: the images that the policy gets.
        replan_every: how many actions of a chunk are executed before the policy is queried again;
            all of them by default.
        max_steps: instead of the task's.
        policy_seed: the policy's seed is this more than the episode's.
    """

    cameras: tuple[Camera, ...] = ()
    replan_every: int | None = None
    max_steps: int | None = None
    policy_seed: int = 0


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
    """Runs episodes in one process: a function from a job to the record of its episode.

    Environment and policy are made at once, the untrained baseline when it is first needed; all
    are kept.

    Args:
        link: to a ``PolicyServer``, where there are served policies.

    Raises:
        SpecMismatch: the policy is for another robot, or wants cameras that are not there.
        FluxError: environment or policy cannot be had.
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
            record["pictures"] = {"sizes": sizes, "by": self.environment.drawn_by()}
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


def run_episode(
    environment: Environment,
    actor: Actor,
    task: TaskSpec,
    seed: int,
    settings: RolloutSettings,
    instruction_of: TaskSpec | None = None,
    on_step: OnStep | None = None,
) -> dict[str, Any]:
    """Run one episode; everything in it follows from the arguments alone.

    A chunk that is not finite ends it: the policy has failed, as on a robot, where safety stops
    it. A simulation that diverges is an error of the environment, and says nothing about the
    policy.

    Args:
        seed: seed of the environment and, with ``settings.policy_seed``, policy.
        instruction_of: the task whose instruction the policy gets instead of that of ``task``, one
            of the environment's ``other_tasks``.
        on_step: called with the environment and the number of steps, before the first step and
            after each, for a video.

    Returns:
        JSON values: ``success``, ``problem`` (what the policy did wrong, else None),
        ``behaviours`` (if the environment reports them), ``steps``, ``calls`` (of the policy),
        ``clamped`` (actions beyond the limits), ``return`` (sum of rewards), ``state_hash``,
        ``instruction``, and ``timing`` in seconds: ``seconds``, ``policy_seconds``,
        ``step_seconds``, ``observe_seconds``.

    Raises:
        SpecMismatch: the policy's chunk is of another shape.
        Diverged: the environment's state is not finite, or its simulation diverged.
    """
    began = time.perf_counter()
    spent = dict.fromkeys(("policy", "step", "observe"), 0.0)
    environment, actor = Environment.adapt(environment), Actor.adapt(actor)
    environment.reset(seed, task.name)
    if instruction_of is not None:
        environment.set_instruction(instruction_of.name)
    actor.enter(environment)
    actor.reset(settings.policy_seed + seed)
    spec, limit = environment.spec, settings.max_steps or task.max_steps
    commands = ChunkCommands(spec, actor.action_rate_hz)
    start = check_step(environment, 0)
    commands.start(start)
    own_hash = implements(environment, Environment, "state_hash")
    state_digest = hashlib.sha256(start.tobytes())
    steps = calls = 0
    total, success, ended = 0.0, False, False
    behaviours: dict[str, bool] | None = None
    problem: str | None = None
    # The environment may have another instruction for each episode.
    instruction = (instruction_of or task).instruction
    stride = history_stride(actor, spec.embodiment.rate_hz)
    before: deque[Observation] = deque(maxlen=max(actor.n_obs_steps - 1, 0))
    if on_step is not None:
        on_step(environment, 0)
    while not ended and steps < limit:
        at = time.perf_counter()
        observation = environment.observe(settings.cameras)
        instruction = observation["task_description"]
        # Before the policy is queried: what it makes of such a state is not its fault.
        check_state(observation["qpos"], steps)
        observed_at = time.perf_counter()
        asked = with_history(observation, actor.n_obs_steps, tuple(before))
        chunk = shaped(actor.predict_action(asked), spec.embodiment.dim)
        answered = time.perf_counter()
        before.append(observation)
        del observation, asked  # so that the next images can have its memory: fresh pages cost more
        spent["observe"] += observed_at - at
        spent["policy"] += answered - observed_at
        calls += 1
        problem = not_finite(chunk, spec.embodiment.joint_names)
        if problem is not None:
            success = False
            break
        targets = commands.targets(chunk[: settings.replan_every])
        for left, target in zip(reversed(range(len(targets))), targets, strict=True):
            at = time.perf_counter()
            outcome = environment.step(commands.command(target))
            spent["step"] += time.perf_counter() - at
            steps += 1
            total += outcome.reward
            # Before anything is made of it: a scene that resets itself may even look like success.
            state = check_step(environment, steps)
            success, ended = bool(outcome.success), bool(outcome.ended)
            behaviours = None if outcome.behaviours is None else dict(outcome.behaviours)
            if not own_hash:
                state_digest.update(state.tobytes())
            if on_step is not None:
                on_step(environment, steps)
            if ended or steps >= limit:
                break
            if left and left % stride == 0 and left // stride < actor.n_obs_steps:
                at = time.perf_counter()
                before.append(environment.observe(settings.cameras))
                spent["observe"] += time.perf_counter() - at
    return {
        "success": success,
        "problem": problem,
        **({} if behaviours is None else {"behaviours": behaviours}),
        "steps": steps,
        "calls": calls,
        "clamped": commands.clamped,
        "return": float(total),
        "state_hash": environment.state_hash() if own_hash else state_digest.hexdigest()[:16],
        "instruction": instruction,
        "timing": {
            "seconds": time.perf_counter() - began,
            **{f"{name}_seconds": value for name, value in spent.items()},
        },
    }


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
            next="evaluate without it: --set eval.instruction_swap=false",
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
