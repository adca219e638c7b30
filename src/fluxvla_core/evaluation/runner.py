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

from fluxvla_core.build import RunContext, bind_options, build_environment_from_cfg
from fluxvla_core.contracts.environment import Environment, EnvironmentSpec, TaskSpec
from fluxvla_core.contracts.runner import Runner
from fluxvla_core.control.joiners import make_joiner
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
    shard_of,
)
from fluxvla_core.evaluation.live import LiveSettings, live_options
from fluxvla_core.evaluation.options import EvalOptions
from fluxvla_core.evaluation.policies import (
    FROM_CHECKPOINT,
    UNTRAINED,
    chosen_checkpoint,
    load,
    match_checkpoint,
    policy_tables,
    resolve_policy,
)
from fluxvla_core.evaluation.policy_server import PolicyServer
from fluxvla_core.evaluation.pool import WorkerPool
from fluxvla_core.evaluation.provenance import Code, code_of, rendering, unseen_seeds
from fluxvla_core.evaluation.success_rates import count_behaviours, count_obeyed, instruction_test
from fluxvla_core.evaluation.videos import (
    VideoSettings,
    choose_episodes,
    record_videos,
    recorded_videos,
    with_others,
)
from fluxvla_core.evaluation.worker import EpisodeWorker, Job, Settings, run_in_pool

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
        **options: the settings, by the fields of ``EvalOptions``.

    Raises:
        ConfigError: a value is impossible.
    """

    api: ClassVar[str] = "1.0"
    Options: ClassVar[type[EvalOptions]] = EvalOptions
    """The settings: its fields are the constructor's further keywords."""
    keeps_config: ClassVar[bool] = True
    """The resolved config is kept with the results, in their folder."""

    def __init__(
        self,
        cfg: Mapping[str, Any] | None = None,
        context: RunContext | None = None,
        **options: Any,
    ) -> None:
        self.context = context or RunContext(config=cfg or {})
        name = type(self).__name__
        self.options = given = bind_options(self.Options, options, name, self.context)
        given.check(self.context)
        if given.environment is None:
            raise ConfigError(
                f"{name} has no environment: where is the policy to act?",
                where=self.context.where(self.context.section),
                next=f"--set '{self.context.section}.environment={{type = \"CLASS\"}}'; "
                "fluxvla plugins list shows the environments",
            )
        self._environment = results_file.as_json(given.environment)
        self._live: dict[str, Any] | None = results_file.as_json(live_options(given.live))
        self.folder = Path(self.context.work_dir) / (FOLDER if self._live is None else LIVE_FOLDER)
        self.task_names = given.tasks
        """The tasks to evaluate, None for all; subclasses may set it before ``run_setup``."""
        self.shard = shard_of()
        # Under torchrun, nproc is the number of its processes, not of each one's workers.
        nproc = None if "WORLD_SIZE" in os.environ else self.context.nproc
        usual = 2 if self._live is None else 1
        self.workers = nproc or (usual if given.workers is None else given.workers)
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
            SpecMismatch: the policy is for another robot.
        """
        given = self.options
        environment = Environment.adapt(build_environment_from_cfg(self._environment))
        self._spec = environment.spec
        table = (
            given.policy if isinstance(given.policy, str) else results_file.as_json(given.policy)
        )
        policy = resolve_policy(table, environment)
        environment.close()
        try:
            video = VideoSettings.of(
                self._spec,
                given.video_cameras,
                given.video_height,
                given.video_width,
                given.video_fps,
            )
        except ConfigError as error:
            raise self.config_error("video_cameras", error.what) from error
        self._tasks = self._spec.select_tasks(self.task_names)
        if policy in FROM_CHECKPOINT or given.baseline:
            given.source(policy, None).check()
            self._checkpoint = chosen_checkpoint(given.ckpt_path, Path(self.context.work_dir))
            self.context.reporter.info(f"evaluating {self._checkpoint['path']}")
        path = None if self._checkpoint is None else self._checkpoint["path"]
        if path is not None:
            self._check_joining(path)
            match_checkpoint(path, given.dataset, self._spec)
        sources = {POLICY: given.source(policy, path)}
        if given.baseline:
            sources[UNTRAINED] = given.source(UNTRAINED, path)
        self._settings = Settings(
            environment=self._environment,
            tasks=tuple(task.name for task in self._tasks),
            sources=sources,
            rollout=given.rollout,
            size=given.size,
            video=video,
            live=self._live_settings(self._spec),
        )
        tables = [self._environment, policy, given.dataset, given.denormalize_action]
        if path is not None:
            tables += policy_tables(path)
        simulators = environment.distributions
        seeds = range(given.seed, given.seed + given.episodes)
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
            self.options.reuse,
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
            shown = with_others(choose_episodes(records, self.options.record_videos), records)
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
        found["provenance"] |= {"unseen_seeds": self._unseen, "images": rendering(records)}
        if self._live is not None:
            found["live"] = results_file.ticks(records)
        results_file.save_results(self.folder, found, self.context)
        if new:  # what others have to try again is theirs: failing here would end them, too
            results_file.check_all_done(records, log.path)
        return found

    def keys(self) -> list[EpisodeKey]:
        """Every episode of the evaluation, in the order in which they are given out."""
        given = self.options
        groups = [(POLICY, given.seed)]
        groups += [(SWAPPED, given.first_swap_seed)] if given.instruction_swap else []
        groups += [(UNTRAINED, given.seed)] if given.baseline else []
        tasks = [task.name for task in self._tasks]
        return episode_keys(groups, tasks, given.episodes, self._ready()[0].keep_together)

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
        if self.options.instruction_swap:
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
        return self.context.error(key, problem)

    @contextmanager
    def _pool(self) -> Iterator[WorkerPool]:
        settings = self._ready()[1]
        loaders = {
            name: partial(load, source)
            for name, source in settings.sources.items()
            if self.options.serves_policy and source.policy in FROM_CHECKPOINT
        }
        timeout = self.options.episode_timeout_s
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
        if self.options.replan_every is not None:
            options.setdefault("execute_horizon", self.options.replan_every)
        fps = self.options.video_fps if self.options.record_videos else None
        return LiveSettings(options, str(self.folder / RECORDS), fps)

    def _check_joining(self, path: str) -> None:
        """Refuse a checkpoint whose model cannot act as ``live`` says, before it is loaded."""
        if self._live is None or not make_joiner(self._live["chunk_joining"]).continues:
            return
        from fluxvla_core.policies.loading import why_not_continued

        why = why_not_continued(path)
        if why is not None:
            given = self._live["chunk_joining"]
            raise self.config_error("live", f"has chunk_joining {given!r}, and {why}")

    def _ready(self) -> tuple[EnvironmentSpec, Settings]:
        assert self._spec is not None, "run_setup() comes first"
        assert self._settings is not None
        return self._spec, self._settings
