"""How often a policy does what it is told in simulation, over seeds it has not seen."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from fluxvla_core.build import RunContext
from fluxvla_core.errors import ConfigError
from fluxvla_core.evaluate.episodes import open_ledger, run_in_pool
from fluxvla_core.evaluate.ledger import DONE, EpisodeKey
from fluxvla_core.evaluate.pool import WorkerPool
from fluxvla_core.evaluate.results import FORMAT, check_any_done, tell, timing, write_results
from fluxvla_core.evaluate.showing import choose_episodes, record_videos
from fluxvla_core.evaluate.subject import chosen_checkpoint
from fluxvla_core.evaluate.summary import summarise
from fluxvla_sim.eval_worker import (
    POLICY,
    SWAPPED,
    UNTRAINED,
    Job,
    Settings,
    SimEvalWorker,
    other_task,
)

FOLDER = "eval"


class SimEvalRunner:
    """Evaluates a policy on tasks of the simulated robot that a subclass names.

    Every episode's outcome follows from the policy, its task and its seed; the number of workers
    changes nothing but the time. An evaluation that was interrupted goes on where it was when it
    is started again in the same work dir.

    Writes ``<work_dir>/eval/``: ``results.json``, ``episodes.jsonl``, ``videos/*.mp4``.

    Args:
        cfg: the whole config (injected).
        context: what the run knows (injected): work dir, reporter.
        ckpt_path: checkpoint or work dir; the newest whole one of the work dir by default.
        policy: ``checkpoint``, or ``expert`` or ``untrained`` for comparison.
        episodes: for each task.
        seed: of each task's first episode; the others count up from it.
        tasks: names of the tasks; the robot's usual ones by default.
        replan_every: how many keyframes of a chunk are used before the policy is asked again.
        max_steps: control steps (20 ms) after which an episode ends; the task's own by default.
        instruction_swap: also tell the policy the other task's instruction, on seeds of its own,
            and count which of the two it does.
        baseline: also evaluate the same model with fresh random weights, on the same seeds.
        workers: processes; ``--nproc`` overrides it.
        record_videos: how many episodes to show: failures first, then successes.
        video_camera, video_height, video_width, video_fps: of the videos; by default the robot's
            first camera.
        dataset, denormalize_action: instead of what the checkpoint says, see ``load_policy``.
        height, width: of the policy's pictures; as in its training data by default.
        quality: ``cheap`` or ``reference`` pictures, see ``fluxvla_sim.render``.
        device, mixed_precision_dtype: of the policy.
        episode_timeout_s: an episode that takes longer is tried again in a new process.

    Raises:
        ConfigError: a value is impossible.
    """

    api: ClassVar[str] = "1.0"
    robot: ClassVar[str]

    def __init__(
        self,
        cfg: Mapping[str, Any] | None = None,
        context: RunContext | None = None,
        ckpt_path: str | None = None,
        policy: str = "checkpoint",
        episodes: int = 50,
        seed: int = 500,
        tasks: Sequence[str] | None = None,
        replan_every: int = 5,
        max_steps: int | None = None,
        instruction_swap: bool = False,
        baseline: bool = False,
        workers: int = 2,
        record_videos: int = 4,
        video_camera: str | None = None,
        video_height: int = 240,
        video_width: int = 320,
        video_fps: float = 25.0,
        dataset: Any = None,
        denormalize_action: Any = None,
        height: int | None = None,
        width: int | None = None,
        quality: str = "cheap",
        device: str = "cpu",
        mixed_precision_dtype: str = "float32",
        episode_timeout_s: float = 600.0,
    ) -> None:
        from fluxvla_sim.robots import ROBOTS

        self._robot = ROBOTS[self.robot]
        self.context = context or RunContext(config=cfg or {})
        self.ckpt_path = ckpt_path
        self.policy = policy
        self.episodes = episodes
        self.seed = seed
        self.tasks = tuple(self._robot.default_tasks if tasks is None else tasks)
        self.instruction_swap = instruction_swap
        self.baseline = baseline
        self.workers = self.context.nproc if self.context.nproc > 1 else workers
        self.record_videos = record_videos
        self.episode_timeout_s = episode_timeout_s
        self.folder = Path(self.context.work_dir) / FOLDER
        self._settings = Settings(
            robot=self.robot,
            policy=policy,
            ckpt_path=None,
            replan_every=replan_every,
            max_steps=max_steps,
            quality=quality,
            device=device,
            mixed_precision_dtype=mixed_precision_dtype,
            dataset=dataset,
            denormalize_action=denormalize_action,
            height=height,
            width=width,
            video_camera=video_camera or self._robot.cameras[0],
            video_size=(video_height, video_width),
            video_fps=video_fps,
        )
        self._checkpoint: dict[str, Any] | None = None
        self._check()

    def run_setup(self) -> None:
        """Find the checkpoint.

        Raises:
            CheckpointError: there is none, or the one that is named is damaged.
        """
        from fluxvla_sim.policies import NEEDS_CHECKPOINT

        if self.policy not in NEEDS_CHECKPOINT and not self.baseline:
            return
        self._checkpoint = chosen_checkpoint(self.ckpt_path, Path(self.context.work_dir))
        self.context.reporter.info(f"evaluating {self._checkpoint['path']}")

    def run(self) -> dict[str, Any]:
        """Run the episodes, write ``results.json``, and return what is in it.

        Raises:
            SpecMismatch: the policy is for another robot.
            RunFailed: no episode gave a result, or results cannot be written.
        """
        reporter, keys = self.context.reporter, self._keys()
        ledger = open_ledger(self.folder / "episodes.jsonl", self._what(), reporter)
        new = sum(key not in ledger for key in keys)
        factory = partial(SimEvalWorker, self._worker_settings())
        with WorkerPool(factory, self.workers, timeout_s=self.episode_timeout_s) as pool:
            began = time.monotonic()
            records = run_in_pool(pool, keys, ledger, reporter)
            # Loading libraries and models is not what is measured.
            seconds = time.monotonic() - began - (pool.ready_s or 0.0)
            check_any_done(records, ledger.path)
            shown = choose_episodes(records, self.record_videos)
            videos = record_videos(pool, shown, self.folder / "videos", Job, reporter)
        results = {
            "groups": summarise(records),
            "behaviours": count_behaviours(records),
            "checkpoint": self._checkpoint,
            "settings": self._what()["settings"],
            "videos": videos,
            "timing": timing(records, new, seconds, self.workers),
        }
        path = self.folder / "results.json"
        write_results(path, {"format": FORMAT, "policy": self.policy, **results})
        reporter.artifact("evaluation", path)
        tell(reporter, results, self.folder)
        return results

    def _check(self) -> None:
        from fluxvla_sim.policies import POLICIES
        from fluxvla_sim.render import QUALITIES

        settings, robot = self._settings, self._robot
        if self.policy not in POLICIES:
            raise self._wrong("policy", f"{self.policy!r} is none of {', '.join(POLICIES)}")
        for task in self.tasks:
            robot.find(task)
        if not self.tasks or len(set(self.tasks)) != len(self.tasks):
            raise self._wrong("tasks", f"must name each task once, got {list(self.tasks)}")
        if settings.quality not in QUALITIES:
            raise self._wrong("quality", f"{settings.quality!r} is none of {', '.join(QUALITIES)}")
        if settings.video_camera not in robot.cameras:
            known = ", ".join(robot.cameras)
            raise self._wrong("video_camera", f"{settings.video_camera!r} is none of {known}")
        for name, value in (
            ("episodes", self.episodes),
            ("workers", self.workers),
            ("replan_every", settings.replan_every),
        ):
            if value < 1:
                raise self._wrong(name, f"must be at least 1, got {value}")
        for task in self.tasks:
            least = robot.find(task)[0].max_steps
            if settings.max_steps is not None and settings.max_steps < least:
                raise self._wrong(
                    "max_steps", f"must be at least {least} for {task}; got {settings.max_steps}"
                )
            if self.instruction_swap and other_task(robot, task) == task:
                raise self._wrong(
                    "instruction_swap",
                    f"is impossible: nothing else can be asked for where {task} is",
                )

    def _wrong(self, name: str, what: str) -> ConfigError:
        return ConfigError(
            f"{name} {what}", where=self.context.where(f"{self.context.section}.{name}")
        )

    def _worker_settings(self) -> Settings:
        path = None if self._checkpoint is None else self._checkpoint["path"]
        return replace(self._settings, ckpt_path=path)

    def _keys(self) -> list[EpisodeKey]:
        def keys(group: str, first: int) -> list[EpisodeKey]:
            seeds = range(first, first + self.episodes)
            # Tasks take turns, so that an evaluation that is watched tells of both from the start.
            return [EpisodeKey(group, task, seed) for seed in seeds for task in self.tasks]

        found = keys(POLICY, self.seed)
        if self.instruction_swap:
            # The scenes of both tasks are alike, so the same seeds would repeat what is known.
            found += keys(SWAPPED, self.seed + self.episodes)
        if self.baseline:
            found += keys(UNTRAINED, self.seed)
        return found

    def _what(self) -> dict[str, Any]:
        """What outcomes follow from, beside each episode's key."""
        settings = self._settings
        return {
            "policy": self.policy,
            "checkpoint": None if self._checkpoint is None else self._checkpoint["sha256"],
            "settings": {
                "replan_every": settings.replan_every,
                "max_steps": settings.max_steps,
                "quality": settings.quality,
                "device": settings.device,
                "mixed_precision_dtype": settings.mixed_precision_dtype,
                "height": settings.height,
                "width": settings.width,
                "dataset": _plain(settings.dataset),
                "denormalize_action": _plain(settings.denormalize_action),
            },
        }


class AlohaSimEvalRunner(SimEvalRunner):
    """On gym-aloha's scenes: ``lift_hold``, ``transfer_cube`` and ``insertion``."""

    robot: ClassVar[str] = "aloha"


class URSimEvalRunner(SimEvalRunner):
    """On the UR5e at its table: ``lift_cube``."""

    robot: ClassVar[str] = "ur5e"


def count_behaviours(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Which task was done after which instruction.

    Returns:
        ``{group: {instruction: {"episodes": n, "neither": n, task: n, …}}}``; the counts of a
        wrong instruction tell whether the policy listens.
    """
    table: dict[str, Any] = {}
    for record in records:
        if record["status"] != DONE:
            continue
        said = table.setdefault(record["group"], {})
        empty = {"episodes": 0, "neither": 0, **dict.fromkeys(record["behaviours"], 0)}
        row = said.setdefault(record["instruction"], empty)
        row["episodes"] += 1
        row["neither"] += not any(record["behaviours"].values())
        for task, did in record["behaviours"].items():
            row[task] += bool(did)
    return table


def _plain(table: Any) -> Any:
    return json.loads(json.dumps(table, default=str))
