"""``LiberoEvalRunner``: LIBERO's protocol, with results that follow from seeds alone."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from fluxvla_core.build import RunContext
from fluxvla_core.errors import ConfigError, UsageError
from fluxvla_core.evaluate import mcnemar, results
from fluxvla_core.evaluate.drawing import RENDERS
from fluxvla_core.evaluate.episodes import open_ledger, run_episodes
from fluxvla_core.evaluate.ledger import EpisodeKey
from fluxvla_core.evaluate.pool import run_jobs
from fluxvla_core.evaluate.showing import choose_episodes, video_name
from fluxvla_core.evaluate.subject import chosen_checkpoint
from fluxvla_core.evaluate.summary import summarise
from fluxvla_libero.eval_worker import (
    POLICY,
    SWAPPED,
    UNTRAINED,
    Job,
    LiberoEvalWorker,
    Settings,
)
from fluxvla_libero.policies import NEEDS_CHECKPOINT, POLICIES, Loading
from fluxvla_libero.suites import NUM_STEPS_WAIT, SuiteTask, check_suite, max_steps

FOLDER = "eval"
TRIALS = 50
"""Fixed initial states of each task."""

Records = Sequence[Mapping[str, Any]]


class LiberoEvalRunner:
    """Success of a policy on a LIBERO suite, by task, with intervals.

    The standard protocol: fixed initial states, 10 waiting steps, then at most 220, 280, 300, 520
    or 400 steps (spatial, object, goal, 10, 90); success is the environment's. Each episode's
    outcome follows from the policy, its task and its trial; the number of workers changes nothing
    but the time. An evaluation that was interrupted goes on where it was.

    Writes ``<work_dir>/eval/``: ``results.json``, ``episodes.jsonl``, ``videos/*.mp4``.

    Args:
        cfg: the whole config (injected).
        context: what the run knows (injected): work dir, reporter.
        seed: of the policy; trial ``n`` uses ``seed + n``.
        ckpt_path: checkpoint or work dir; the newest whole one of the work dir by default.
        model_family: for the record only.
        task_suite_name: libero_spatial, _object, _goal, _10, _90, or one of LIBERO-PRO's.
        tasks: which of the suite's, by index or name; all by default.
        dataset, denormalize_action: instead of what the checkpoint says, see ``load_policy``.
        norm_stats_key: which of the checkpoint's statistics.
        eval_chunk_size: how many actions of a chunk are executed before the next is asked for.
        resize_size: side of the policy's pictures, which are drawn in that size; as it was
            trained by default.
        num_trials_per_task: episodes for each task, from the first initial state on; at most 50.
        num_steps_wait: steps that the arm holds still before; they do not count.
        max_steps: instead of the suite's limit.
        mixed_precision_dtype, enable_mixed_precision_training: ``bf16`` inference, if enabled.
        policy: ``checkpoint``, or ``expert`` or ``untrained`` for comparison.
        instruction_swap: repeat every episode with the instruction of another task that could be
            done in the same scene, and test whether the right one does better.
        baseline: repeat every episode with the same model before training.
        render: ``cheap`` pictures (no shadows, no multisampling), ``coarse`` ones (nor details),
            or LIBERO's own: ``reference``.
        workers: processes; ``--nproc`` overrides it.
        record_videos: how many episodes to show: failures first, then successes.
        video_fps: must divide 20.
        device: of torch.
        episode_timeout_s: an episode that takes longer is tried again in a new process.

    Raises:
        ConfigError: a value is impossible.
    """

    api: ClassVar[str] = "1.0"

    def __init__(
        self,
        cfg: Mapping[str, Any] | None = None,
        context: RunContext | None = None,
        seed: int = 7,
        ckpt_path: str | None = None,
        model_family: str | None = None,
        task_suite_name: str = "libero_object",
        tasks: Sequence[int | str] | None = None,
        dataset: Any = None,
        denormalize_action: Any = None,
        norm_stats_key: str | None = None,
        eval_chunk_size: int = 8,
        resize_size: int | None = None,
        num_trials_per_task: int = TRIALS,
        num_steps_wait: int = NUM_STEPS_WAIT,
        max_steps: int | None = None,
        mixed_precision_dtype: str = "bf16",
        enable_mixed_precision_training: bool = False,
        policy: str = "checkpoint",
        instruction_swap: bool = False,
        baseline: bool = False,
        render: str = "cheap",
        workers: int = 2,
        record_videos: int = 4,
        video_fps: float = 10.0,
        device: str = "cpu",
        episode_timeout_s: float = 1800.0,
    ) -> None:
        self.context = context or RunContext(config=cfg or {})
        self.ckpt_path = ckpt_path
        self.model_family = model_family
        self.instruction_swap = instruction_swap
        self.baseline = baseline
        self.trials = num_trials_per_task
        self.workers = self.context.nproc if self.context.nproc > 1 else workers
        self.record_videos = record_videos
        self.episode_timeout_s = episode_timeout_s
        self.folder = Path(self.context.work_dir) / FOLDER
        self._wanted = tasks
        self._tasks: tuple[SuiteTask, ...] = ()
        self._checkpoint: dict[str, Any] | None = None
        self._settings = Settings(
            suite=task_suite_name,
            tasks=(),
            policy=policy,
            loading=Loading(
                dataset=dataset,
                denormalize_action=denormalize_action,
                norm_stats_key=norm_stats_key,
                device=device,
                precision=mixed_precision_dtype if enable_mixed_precision_training else "float32",
            ),
            seed=seed,
            replan_every=eval_chunk_size,
            max_steps=0,
            num_steps_wait=num_steps_wait,
            size=None if resize_size is None else (resize_size, resize_size),
            render=render,
            video_fps=video_fps,
        )
        self._check(max_steps)

    def run_setup(self) -> None:
        """Find suite and checkpoint.

        Raises:
            MissingPlugin, RunFailed: LIBERO is not installed, or does not work.
            ConfigError: the suite has no such task.
            CheckpointError: there is no checkpoint, or the one that is named is damaged.
        """
        from fluxvla_libero.suites import choose_tasks

        self._tasks = choose_tasks(self._settings.suite, self._wanted)
        self._settings = replace(self._settings, tasks=tuple(t.name for t in self._tasks))
        if self._settings.policy in NEEDS_CHECKPOINT or self.baseline:
            self._checkpoint = chosen_checkpoint(self.ckpt_path, Path(self.context.work_dir))
            path = self._checkpoint["path"]
            loading = replace(self._settings.loading, ckpt_path=path)
            self._settings = replace(self._settings, loading=loading)
            self.context.reporter.info(f"evaluating {path}")

    def run(self) -> dict[str, Any]:
        """Run the episodes, write ``results.json``, and return what is in it.

        Raises:
            SpecMismatch: the policy's numbers mean something else than LIBERO's.
            RunFailed: no episode gave a result, or results cannot be written.
        """
        reporter, keys = self.context.reporter, self._keys()
        ledger = open_ledger(self.folder / "episodes.jsonl", self._what(), reporter)
        began, new = time.monotonic(), sum(key not in ledger for key in keys)
        records = run_episodes(
            partial(LiberoEvalWorker, self._settings),
            keys,
            ledger,
            self.workers,
            reporter,
            self.episode_timeout_s,
        )
        seconds = time.monotonic() - began
        results.check_any_done(records, ledger.path)
        found = {
            "format": results.FORMAT,
            "policy": self._settings.policy,
            "checkpoint": self._checkpoint,
            "settings": self._what()["settings"],
            "groups": summarise(records),
            "instruction_test": instruction_test(records),
            "behaviours": count_behaviours(records),
            "videos": self._videos(records),
            "timing": results.timing(records, new, seconds, self.workers),
        }
        results.write_results(self.folder / "results.json", found)
        reporter.artifact("evaluation", self.folder / "results.json")
        results.tell(reporter, found, self.folder)
        if found["instruction_test"] is not None:
            reporter.info(
                "right instruction against wrong one: one-sided p = "
                f"{found['instruction_test']['p_a_better']:.2g} (exact McNemar)"
            )
        return found

    def _check(self, limit: int | None) -> None:
        settings = self._settings
        try:
            check_suite(settings.suite)
        except ConfigError as error:
            raise self._wrong("task_suite_name", error.what) from error
        self._settings = replace(settings, max_steps=limit or max_steps(settings.suite))
        if settings.policy not in POLICIES:
            raise self._wrong("policy", f"{settings.policy!r} is none of {', '.join(POLICIES)}")
        if settings.render not in RENDERS:
            raise self._wrong("render", f"{settings.render!r} is none of {', '.join(RENDERS)}")
        if not 1 <= self.trials <= TRIALS:
            raise self._wrong("num_trials_per_task", f"must be 1 to {TRIALS}, got {self.trials}")
        if 20 % settings.video_fps:
            raise self._wrong("video_fps", f"must divide 20, got {settings.video_fps:g}")
        for name, value, least in (
            ("eval_chunk_size", settings.replan_every, 1),
            ("max_steps", self._settings.max_steps, 1),
            ("num_steps_wait", settings.num_steps_wait, 0),
            ("record_videos", self.record_videos, 0),
            ("seed", settings.seed, 0),
            ("workers", self.workers, 1),
            ("resize_size", 16 if settings.size is None else settings.size[0], 16),
        ):
            if value < least:
                raise self._wrong(name, f"must be at least {least}, got {value}")

    def _wrong(self, name: str, what: str) -> ConfigError:
        where = self.context.where(f"{self.context.section}.{name}")
        return ConfigError(f"{name}: {what}", where=where)

    def _keys(self) -> list[EpisodeKey]:
        """Task by task, so that a worker builds few scenes; a trial's groups side by side."""
        if not self._tasks:
            raise UsageError("LiberoEvalRunner: call run_setup() before run()")
        groups = [POLICY]
        groups += [SWAPPED] if self.instruction_swap else []
        groups += [UNTRAINED] if self.baseline else []
        return [
            EpisodeKey(group, task.name, trial)
            for task in self._tasks
            for trial in range(self.trials)
            for group in groups
        ]

    def _what(self) -> dict[str, Any]:
        """What outcomes follow from, beside each episode's key."""
        settings = self._settings
        values = asdict(settings)
        loading = values.pop("loading")
        del loading["ckpt_path"]
        for name in ("policy", "tasks", "video_size", "video_fps"):
            del values[name]
        if self.instruction_swap:
            values["wrong_instructions_of"] = settings.tasks
        more = {"model_family": self.model_family} if self.model_family else {}
        return {
            "policy": settings.policy,
            "checkpoint": None if self._checkpoint is None else self._checkpoint["sha256"],
            "settings": json.loads(json.dumps({**values, **loading, **more}, default=str)),
        }

    def _videos(self, records: Records) -> list[dict[str, Any]]:
        """Run the chosen episodes once more, watched: they go as they went before."""
        chosen = choose_episodes(records, self.record_videos)
        folder = self.folder / "videos"
        for old in folder.glob("*.mp4"):
            old.unlink()
        names = [video_name(number, record) for number, record in enumerate(chosen)]
        jobs = [
            Job(EpisodeKey(r["group"], r["task"], r["seed"]), str(folder / name))
            for r, name in zip(chosen, names, strict=True)
        ]
        reporter, made = self.context.reporter, [False] * len(jobs)
        factory = partial(LiberoEvalWorker, self._settings)
        with closing(
            run_jobs(factory, jobs, self.workers, timeout_s=self.episode_timeout_s)
        ) as outcomes:
            for done, outcome in enumerate(outcomes, 1):
                reporter.progress("videos", done, len(jobs))
                made[outcome.index] = outcome.error is None
                if outcome.error is not None:
                    reporter.warn(f"no video {names[outcome.index]}: {outcome.error}")
                elif outcome.result["state_hash"] != chosen[outcome.index]["state_hash"]:
                    reporter.warn(
                        f"{names[outcome.index]}: the episode went another way than when it was "
                        "counted; its outcome does not follow from its trial alone"
                    )
        return [
            {**{k: r[k] for k in ("group", "task", "seed", "success")}, "path": f"videos/{name}"}
            for r, name, there in zip(chosen, names, made, strict=True)
            if there
        ]


def instruction_test(records: Records) -> dict[str, Any] | None:
    """Whether the policy does a scene's task more often when it is told to than when it is told
    another: exact McNemar over the same trials. None without wrong instructions."""
    swapped = [r for r in records if r["group"] == SWAPPED]
    if not swapped:
        return None
    right = [r for r in records if r["group"] == POLICY]
    return mcnemar.compare(right, swapped).to_dict()


def count_behaviours(records: Records) -> dict[str, Any]:
    """Which tasks were done after which instruction.

    Returns:
        ``{group: {instruction: {"episodes": n, "neither": n, task: n, …}}}``; tasks that were
        never done after an instruction are left out.
    """
    table: dict[str, Any] = {}
    for record in records:
        if record["status"] != "done":
            continue
        said = table.setdefault(record["group"], {})
        row = said.setdefault(record["instruction"], {"episodes": 0, "neither": 0})
        row["episodes"] += 1
        row["neither"] += not any(record["behaviours"].values())
        for task, did in record["behaviours"].items():
            if did:
                row[task] = row.get(task, 0) + 1
    return table
