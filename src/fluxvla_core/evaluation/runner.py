"""``EvalRunner``: evaluates a policy's success rate in any environment.

Every episode's outcome follows from the policy, its task and its seed. Neither the number of
processes, nor the machines, nor an interruption changes anything but the time.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from fluxvla_core.build import RunContext, build_environment_from_cfg
from fluxvla_core.contracts.environment import Environment, EnvironmentSpec, TaskSpec
from fluxvla_core.contracts.runner import Runner
from fluxvla_core.errors import ConfigError
from fluxvla_core.evaluation import results_file
from fluxvla_core.evaluation.episodes import (
    POLICY,
    SWAPPED,
    EpisodeKey,
    EvalLog,
    Shard,
    episode_keys,
    open_eval_log,
    run_in_pool,
    shard_of,
)
from fluxvla_core.evaluation.live import LiveSettings, live_options
from fluxvla_core.evaluation.policies import (
    CHECKPOINT,
    FROM_CHECKPOINT,
    UNTRAINED,
    PolicySource,
    chosen_checkpoint,
    load,
    policy_tables,
    resolve_policy,
)
from fluxvla_core.evaluation.policy_server import PolicyServer
from fluxvla_core.evaluation.pool import WorkerPool
from fluxvla_core.evaluation.provenance import Code, code_of, rendering, unseen_seeds
from fluxvla_core.evaluation.rollout import RolloutSettings
from fluxvla_core.evaluation.success_rates import count_behaviours, count_obeyed, instruction_test
from fluxvla_core.evaluation.videos import (
    VideoSettings,
    choose_episodes,
    record_videos,
    recorded_videos,
    with_others,
)
from fluxvla_core.evaluation.worker import EpisodeWorker, Job, Settings

FOLDER, LIVE_FOLDER = "eval", "eval_live"
RECORDS = "episodes"
"""Where the records of live episodes are, in their evaluation's folder."""


class EvalRunner(Runner):
    """Evaluates a policy in an environment: ``run_setup()``, then ``run()``.

    Writes ``<work_dir>/eval/``: ``results.json``, ``episodes.jsonl``, ``videos/*.mp4``. Started
    again in the same work dir it continues where it was. Started as several processes (torchrun, a
    SLURM array, ``srun``) each runs its part of the episodes, and the last one writes the results.

    Args:
        cfg: the whole config (injected).
        context: what the run knows (injected): work dir, reporter.
        environment: table of a registered environment.
        policy: ``checkpoint``, ``untrained``, ``expert`` (the environment's own), ``random``, or
            the table of a registered policy.
        ckpt_path: checkpoint or work dir; the newest whole one of the work dir by default.
        episodes: for each task.
        seed: seed of each task's first episode; the others count up from it.
        policy_seed: the policy's seed is this more than the episode's.
        tasks: names of the tasks; all by default.
        replan_every: how many actions of a chunk are executed before the policy is queried again;
            all of them by default.
        max_steps: control steps after which an episode ends, instead of the environment's.
        instruction_swap: also give the policy another task's instruction, and test whether the
            right one does better.
        swap_seed: seed of the first of these episodes; by default they repeat those of the policy.
        baseline: also evaluate the same model with fresh random weights, on the same seeds.
        live: on the wall clock, through the control loop and the safety of a robot, into
            ``<work_dir>/eval_live/``: True, or a table with those keys of an inference runner
            that ``live.LIVE_OPTIONS`` lists. Slow policies miss ticks; outcomes depend on the
            machine.
        workers: processes that simulate, 2 by default and 1 live; ``--nproc`` overrides it.
        batch_size: rows of every forward pass of the policy. Results follow from it, because sums
            do; they do not follow from how many of the rows were in use.
        serve_policy: one model in this process answers all workers, in batches; otherwise each
            worker has its own. Changes nothing but time and memory; by default True where
            ``batch_size`` is above 1 or the device is not a CPU.
        record_videos: how many episodes to show: failures first, then successes.
        video_cameras: side by side; the environment's first by default.
        video_height, video_width: of each camera's picture; the environment's own by default.
        video_fps: frames a second.
        dataset, denormalize_action: instead of what the checkpoint says, see ``load_policy``.
        norm_stats_key: which of the checkpoint's statistics.
        height, width: size of the policy's pictures; as in its training data by default.
        device, mixed_precision_dtype: torch device and precision of the policy.
        execution, quantization: how its model computes, see ``load_policy``.
        episode_timeout_s: an episode that takes longer is tried again in a new process.
        reuse: also count existing episodes that other code ran (other versions, changed plugins),
            which is an error otherwise.

    Raises:
        ConfigError: a value is impossible.
        PluginError: there is no such environment.
    """

    api: ClassVar[str] = "1.0"
    keeps_config: ClassVar[bool] = True
    """The resolved config is kept with the results, in their folder."""

    def __init__(
        self,
        cfg: Mapping[str, Any] | None = None,
        context: RunContext | None = None,
        environment: Mapping[str, Any] | None = None,
        policy: str | Mapping[str, Any] = CHECKPOINT,
        ckpt_path: str | None = None,
        episodes: int = 50,
        seed: int = 0,
        policy_seed: int = 0,
        tasks: Sequence[str] | None = None,
        replan_every: int | None = None,
        max_steps: int | None = None,
        instruction_swap: bool = False,
        swap_seed: int | None = None,
        baseline: bool = False,
        live: bool | Mapping[str, Any] = False,
        workers: int | None = None,
        batch_size: int = 1,
        serve_policy: bool | None = None,
        record_videos: int = 4,
        video_cameras: Sequence[str] | None = None,
        video_height: int | None = None,
        video_width: int | None = None,
        video_fps: float = 10.0,
        dataset: Any = None,
        denormalize_action: Any = None,
        norm_stats_key: str | None = None,
        height: int | None = None,
        width: int | None = None,
        device: str = "cpu",
        mixed_precision_dtype: str = "float32",
        execution: str = "eager",
        quantization: str | None = None,
        episode_timeout_s: float = 1800.0,
        reuse: bool = False,
    ) -> None:
        self.context = context or RunContext(config=cfg or {})
        self.shard = shard_of()
        # Under torchrun, nproc is the number of its processes, not of each one's workers.
        nproc = None if "WORLD_SIZE" in os.environ else self.context.nproc
        try:
            self._live: dict[str, Any] | None = results_file.as_json(live_options(live))
        except ConfigError as error:
            raise self.config_error("live", error.what) from error
        usual = 2 if self._live is None else 1
        self.workers = nproc or (usual if workers is None else workers)
        self.ckpt_path = ckpt_path
        self.episodes = episodes
        self.seed = seed
        self.swap_seed = seed if swap_seed is None else swap_seed
        self.instruction_swap = instruction_swap
        self.baseline = baseline
        self.record_videos = record_videos
        self.episode_timeout_s = episode_timeout_s
        self.reuse = reuse
        self.folder = Path(self.context.work_dir) / (FOLDER if self._live is None else LIVE_FOLDER)
        self.task_names = tasks
        """The tasks to evaluate, None for all; subclasses may set it before ``run_setup``."""
        for name, value, least in (
            ("episodes", episodes, 1),
            ("workers", self.workers, 1),
            ("batch_size", batch_size, 1),
            ("replan_every", replan_every, 1),
            ("max_steps", max_steps, 1),
            ("record_videos", record_videos, 0),
            ("seed", seed, 0),
            ("swap_seed", swap_seed, 0),
        ):
            if value is not None and value < least:
                raise self.config_error(name, f"must be at least {least}, got {value}")
        if (height is None) != (width is None):
            raise self.config_error("height", "and width belong together: give both or none")
        if video_fps <= 0:
            raise self.config_error("video_fps", f"must be positive, got {video_fps:g}")
        if self._live is not None and instruction_swap:
            raise self.config_error("instruction_swap", "cannot be live: evaluate it stepped")
        if environment is None:
            raise ConfigError(
                f"{type(self).__name__} has no environment: where is the policy to act?",
                where=self.context.where(self.context.section),
                next=f"--set '{self.context.section}.environment={{type = \"CLASS\"}}'; "
                "fluxvla plugins list shows the environments",
            )
        self._environment = results_file.as_json(environment)
        self._video = (video_cameras, video_height, video_width, video_fps)
        self._policy = policy if isinstance(policy, str) else results_file.as_json(policy)
        self._source = PolicySource(
            policy=CHECKPOINT,
            dataset=dataset,
            denormalize_action=denormalize_action,
            norm_stats_key=norm_stats_key,
            device=device,
            precision=mixed_precision_dtype,
            batch_size=batch_size,
            execution=execution,
            quantization=quantization,
        )
        served = batch_size > 1 or not device.startswith("cpu")
        self._serve = served if serve_policy is None else serve_policy
        self._rollout = RolloutSettings((), replan_every, max_steps, policy_seed)
        self._size = None if height is None or width is None else (height, width)
        self._checkpoint: dict[str, Any] | None = None
        self._spec: EnvironmentSpec | None = None
        self._tasks: tuple[TaskSpec, ...] = ()
        self._settings: Settings | None = None
        self._code = Code({}, "")
        self._unseen: bool | None = None

    def run_setup(self) -> None:
        """Look at the environment and find the checkpoint.

        Raises:
            ConfigError: the environment has no such task or camera, or names no expert; or the
                policy cannot compute here as it should.
            CheckpointError: there is no checkpoint, or the one that is named is damaged.
        """
        environment = Environment.adapt(build_environment_from_cfg(self._environment))
        self._spec = environment.spec
        policy = resolve_policy(self._policy, environment)
        environment.close()
        names, height, width, fps = self._video
        try:
            video = VideoSettings.of(self._spec, names, height, width, fps)
        except ConfigError as error:
            raise self.config_error("video_cameras", error.what) from error
        self._tasks = self._spec.select_tasks(self.task_names)
        if policy in FROM_CHECKPOINT or self.baseline:
            self._source.check()
            self._checkpoint = chosen_checkpoint(self.ckpt_path, Path(self.context.work_dir))
            self.context.reporter.info(f"evaluating {self._checkpoint['path']}")
        path = None if self._checkpoint is None else self._checkpoint["path"]
        sources = {POLICY: replace(self._source, policy=policy, ckpt_path=path)}
        if self.baseline:
            sources[UNTRAINED] = replace(sources[POLICY], policy=UNTRAINED)
        self._settings = Settings(
            environment=self._environment,
            tasks=tuple(task.name for task in self._tasks),
            sources=sources,
            rollout=self._rollout,
            size=self._size,
            video=video,
            live=self._live_settings(self._spec),
        )
        tables = [self._environment, policy, self._source.dataset, self._source.denormalize_action]
        if path is not None:
            tables += policy_tables(path)
        simulators = environment.distributions
        seeds = range(self.seed, self.seed + self.episodes)
        self._unseen = unseen_seeds(tables, self._environment.get("type"), seeds)
        self._code = code_of(tables, simulators, () if path is None else ("torch",))

    def run(self) -> dict[str, Any]:
        """Run this process's episodes; write ``results.json`` once all there are have ended.

        Returns:
            What is in ``results.json``, or, while other processes have episodes to run, ``shard``
            and ``episodes_left``.

        Raises:
            SpecMismatch: the policy is for another robot.
            UsageError: there are episodes that other code ran, and ``reuse`` is not set.
            RunFailed: an episode gave no result after all attempts (the results of the others are
                written), or results cannot be written.
        """
        reporter, keys = self.context.reporter, self.keys()
        identity = self.identity()
        log = open_eval_log(
            self.folder / self.shard.log_name,
            identity,
            reporter,
            "episodes*.jsonl",
            self._code.to_dict(),
            self.reuse,
        )
        mine = self.shard.of(keys)
        new = sum(key not in log for key in mine)
        with self._pool() as pool:
            began = time.monotonic()
            run_in_pool(pool, mine, log, reporter)
            # Loading libraries and models is not what is measured.
            seconds = time.monotonic() - began - (pool.ready_s or 0.0)
            log.read_other_logs()
            records = log.settled(keys)
            if records is None:
                return self._leave_to_others(keys, log)
            results_file.check_any_done(records, log.path)
            shown = with_others(choose_episodes(records, self.record_videos), records)
            if self._live is None:
                videos = record_videos(pool, shown, self.folder / "videos", Job, reporter)
            else:
                recordings = [(r, self.folder / RECORDS / r["record"]) for r in shown]
                videos = recorded_videos(recordings, self.folder)
        policy = identity["policy"]
        found = results_file.assemble(
            records,
            log,
            policy=policy if isinstance(policy, str) else policy["type"],
            mode="stepped" if self._live is None else "live",
            checkpoint=self._checkpoint,
            settings=identity["settings"],
            code=self._code,
            videos=videos,
            timing=results_file.timing(records, new, seconds, self.workers),
        )
        found |= {
            "environment": identity["environment"]["type"],
            "instruction_test": instruction_test(records),
            "behaviours": count_behaviours(records),
            "obeyed": count_obeyed(records),
        }
        found["provenance"] |= {"unseen_seeds": self._unseen, "pictures": rendering(records)}
        if self._live is not None:
            found["live"] = results_file.ticks(records)
        results_file.save_results(self.folder, found, self.context)
        if new:  # what others have to try again is theirs: failing here would end them, too
            results_file.check_all_done(records, log.path)
        return found

    def keys(self) -> list[EpisodeKey]:
        """Every episode of the evaluation, in the order in which they are given out."""
        groups = [(POLICY, self.seed)]
        groups += [(SWAPPED, self.swap_seed)] if self.instruction_swap else []
        groups += [(UNTRAINED, self.seed)] if self.baseline else []
        tasks = [task.name for task in self._tasks]
        return episode_keys(groups, tasks, self.episodes, self._ready()[0].keep_together)

    def identity(self) -> dict[str, Any]:
        """Everything that outcomes follow from, besides each episode's key, as JSON values."""
        spec, settings = self._ready()
        source = asdict(settings.sources[POLICY])
        policy = source.pop("policy")
        del source["ckpt_path"]
        rollout = asdict(settings.rollout)
        del rollout["cameras"]
        values: dict[str, Any] = {**rollout, "size": settings.size, **source, **spec.details}
        if self._live is not None:
            values["live"] = self._live
        if self.instruction_swap:
            values["wrong_instructions_of"] = settings.tasks
        about: dict[str, Any] = results_file.as_json(
            {
                "policy": policy,
                "environment": self._environment,
                "checkpoint": None if self._checkpoint is None else self._checkpoint["sha256"],
                "settings": values,
            }
        )
        return about

    def config_error(self, key: str, problem: str) -> ConfigError:
        """An error about a key of this section."""
        where = self.context.where(f"{self.context.section}.{key}")
        return ConfigError(f"{key} {problem}", where=where)

    @contextmanager
    def _pool(self) -> Iterator[WorkerPool]:
        settings = self._ready()[1]
        loaders = {
            name: partial(load, source)
            for name, source in settings.sources.items()
            if self._serve and source.policy in FROM_CHECKPOINT
        }
        timeout = self.episode_timeout_s
        if not loaders:
            factory = partial(EpisodeWorker, settings)
            with WorkerPool(factory, self.workers, timeout_s=timeout) as pool:
                yield pool
            return
        with PolicyServer(loaders) as server:
            factory = partial(EpisodeWorker, replace(settings, served=server.facts))
            with WorkerPool(factory, self.workers, timeout_s=timeout, link=server.link) as pool:
                yield pool

    def _leave_to_others(self, keys: Sequence[EpisodeKey], log: EvalLog) -> dict[str, Any]:
        left = sum(log.settled([key]) is None for key in keys)
        part: Shard = self.shard
        self.context.reporter.info(
            f"part {part.index} of {part.count} is done; {left} episodes of other parts are not: "
            "the process that ends last writes the results"
        )
        return {"shard": part.index, "episodes_left": left}

    def _live_settings(self, spec: EnvironmentSpec) -> LiveSettings | None:
        if self._live is None:
            return None
        if not spec.limited:
            raise self.config_error(
                "live",
                f"needs an environment that takes joint targets; {spec.name} does not, and the "
                "safety of a robot cannot be kept for its actions",
            )
        options = dict(self._live)
        if self._rollout.replan_every is not None:
            options.setdefault("execute_horizon", self._rollout.replan_every)
        fps = self._video[3] if self.record_videos else None
        return LiveSettings(options, str(self.folder / RECORDS), fps)

    def _ready(self) -> tuple[EnvironmentSpec, Settings]:
        assert self._spec is not None, "run_setup() comes first"
        assert self._settings is not None
        return self._spec, self._settings
