"""``LiberoInferenceRunner``: a policy does one task in a LIBERO scene, and everybody can watch."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

from fluxvla_core.build import RunContext
from fluxvla_core.errors import ConfigError, UsageError
from fluxvla_core.evaluate.drawing import check_render
from fluxvla_core.evaluate.subject import chosen_checkpoint
from fluxvla_core.infer.sources import task_source, tasks
from fluxvla_core.infer.tasks import Task, check_descriptions
from fluxvla_core.record.trace import EpisodeTrace, next_folder
from fluxvla_libero.embodiment import CONTROL_HZ, SCENE_CAMERAS, check_policy, libero_spec
from fluxvla_libero.eval_runner import TRIALS
from fluxvla_libero.policies import NEEDS_CHECKPOINT, POLICIES, Loading, make_policy
from fluxvla_libero.suites import (
    NUM_STEPS_WAIT,
    SuiteTask,
    can_be_done_in,
    check_suite,
    choose_tasks,
    init_states,
    max_steps,
    suite_tasks,
)

FOLDER = "inference"


class LiberoInferenceRunner:
    """Runs a policy in one scene: ``run_setup()``, then ``run()``.

    ``--task`` names an id of ``task_descriptions`` or an instruction in words; without
    ``task_descriptions`` the ids are the indices of the suite's tasks. Time is simulated.

    Writes ``<work_dir>/inference/<NNN>-<task>/``: ``episode.json``, ``trace.jsonl``, a video for
    each camera of the scene.

    Args:
        cfg: the whole config (injected).
        context: what the run knows (injected): work dir, task, reporter.
        seed: of the policy.
        ckpt_path: checkpoint or work dir; the newest whole one of the work dir by default.
        task_suite_name: whose scenes.
        scene: index or name of the task whose scene it is; by default that of the instruction.
        init_state: which of the scene's 50 fixed states it begins in.
        task_descriptions: id -> instruction.
        dataset, denormalize_action, norm_stats_key: see ``LiberoEvalRunner``.
        eval_chunk_size, resize_size, num_steps_wait, max_steps, render: see there.
        mixed_precision_dtype, enable_mixed_precision_training: see there.
        policy: ``checkpoint``, ``expert`` or ``untrained``.
        video_size: side of the videos' pictures.
        record_fps: of the videos; must divide 20.
        device: of torch.

    Raises:
        ConfigError, UsageError: a value is impossible.
    """

    api: ClassVar[str] = "1.0"

    def __init__(
        self,
        cfg: Mapping[str, Any] | None = None,
        context: RunContext | None = None,
        seed: int = 7,
        ckpt_path: str | None = None,
        task_suite_name: str = "libero_object",
        scene: int | str | None = None,
        init_state: int = 0,
        task_descriptions: Mapping[str, str] | None = None,
        dataset: Any = None,
        denormalize_action: Any = None,
        norm_stats_key: str | None = None,
        eval_chunk_size: int = 8,
        resize_size: int | None = None,
        num_steps_wait: int = NUM_STEPS_WAIT,
        max_steps: int | None = None,
        mixed_precision_dtype: str = "bf16",
        enable_mixed_precision_training: bool = False,
        policy: str = "checkpoint",
        render: str = "cheap",
        video_size: int = 256,
        record_fps: float = 20.0,
        device: str = "cpu",
    ) -> None:
        self.context = context or RunContext(config=cfg or {})
        check_suite(task_suite_name)
        check_render(render)
        if policy not in POLICIES:
            raise ConfigError(f"policy {policy!r} is none of {', '.join(POLICIES)}")
        if not 0 <= init_state < TRIALS:
            raise ConfigError(f"init_state must be 0 to {TRIALS - 1}, got {init_state}")
        if 20 % record_fps:
            raise ConfigError(f"record_fps must divide 20, got {record_fps:g}")
        self.suite = task_suite_name
        self.scene = scene
        self.init_state = init_state
        self.seed = seed
        self.ckpt_path = ckpt_path
        self.task_descriptions = check_descriptions(task_descriptions)
        self.eval_chunk_size = eval_chunk_size
        self.size = None if resize_size is None else (resize_size, resize_size)
        self.num_steps_wait = num_steps_wait
        self.max_steps = max_steps
        self.render = render
        self.video_size = video_size
        self.record_fps = record_fps
        self.policy_name = policy
        self._loading = Loading(
            dataset=dataset,
            denormalize_action=denormalize_action,
            norm_stats_key=norm_stats_key,
            device=device,
            precision=mixed_precision_dtype if enable_mixed_precision_training else "float32",
        )
        self._policy: Any = None
        self._cameras: Any = ()

    def run_setup(self) -> None:
        """Load the policy and hold it against LIBERO's embodiment.

        Raises:
            MissingPlugin, RunFailed: LIBERO is not installed, or does not work.
            SpecMismatch: the policy's numbers mean something else than LIBERO's.
            CheckpointError: there is none, or the one that is named is damaged.
        """
        suite_tasks(self.suite)
        if self.policy_name in NEEDS_CHECKPOINT:
            found = chosen_checkpoint(self.ckpt_path, Path(self.context.work_dir))
            self._loading = replace(self._loading, ckpt_path=found["path"])
        self._policy = make_policy(self.policy_name, self._loading)
        self._cameras = check_policy(self._policy, self.size)

    def run(self) -> list[dict[str, Any]]:
        """Run an episode for each task that is asked for; returns their summaries.

        Raises:
            UsageError: the task is unknown, or cannot be done in the scene.
            RunFailed: the policy's actions are impossible, or recording failed.
        """
        known = self.task_descriptions or {
            str(task.index): task.language for task in suite_tasks(self.suite)
        }
        source = task_source(self.context, known)
        return [self._episode(task) for task in tasks(source, known, lambda: time.sleep(0.05))]

    def _episode(self, asked: Task) -> dict[str, Any]:
        from fluxvla_libero.rollout import Episode, rollout
        from fluxvla_libero.scene import LiberoScene

        where, task = self._resolve(asked)
        reporter = self.context.reporter
        reporter.info(f"{asked.instruction!r} in the scene of {where.name}")
        scene = LiberoScene(where, self.render)
        trace = EpisodeTrace(
            next_folder(Path(self.context.work_dir) / FOLDER, asked.name), self.record_fps
        )
        stride = round(CONTROL_HZ / self.record_fps)

        def watch(action: Any) -> None:
            if action is not None:
                trace.write(
                    {
                        "event": "command",
                        "t": scene.steps / CONTROL_HZ,
                        "command": action,
                        "state": scene.state,
                        "clamps": [],
                    }
                )
            if scene.steps % stride == 0:
                size = self.video_size, self.video_size
                trace.frames({name: scene.render(name, *size) for name in SCENE_CAMERAS})

        summary: dict[str, Any] = {
            "format": "fluxvla-episode-1",
            "task": asked.name,
            "instruction": asked.instruction,
            "scene": where.name,
            "init_state": self.init_state,
            "seed": self.seed,
            "robot": "LIBERO",
            "embodiment": libero_spec().name,
            "joints": list(libero_spec().joint_names),
            "rate_hz": CONTROL_HZ,
            "render": self.render,
            "outcome": "failed",
            "success": None,
        }
        try:
            found = rollout(
                scene,
                self._policy,
                Episode(
                    init_state=init_states(self.suite, where.index)[self.init_state],
                    seed=self.seed,
                    asked=task or replace(where, language=asked.instruction),
                    cameras=self._cameras,
                    replan_every=self.eval_chunk_size,
                    max_steps=self.max_steps or max_steps(self.suite),
                    num_steps_wait=self.num_steps_wait,
                ),
                watch,
            )
            success = None if task is None else found.behaviours[task.name]
            summary |= {
                "outcome": "done" if success else "ended",
                "success": success,
                "steps": found.steps,
                "chunks": found.calls,
                "state_hash": found.state_hash,
            }
        finally:
            trace.close(summary)
            scene.close()
        word = {True: "success", False: "no success", None: "nobody can judge it"}[success]
        reporter.info(f"{word} after {found.steps} steps")
        reporter.artifact("episode", trace.folder)
        return summary

    def _resolve(self, asked: Task) -> tuple[SuiteTask, SuiteTask | None]:
        """The scene, and the suite's task of these words if there is one."""
        words = asked.instruction.casefold().split()
        named = [t for t in suite_tasks(self.suite) if t.language.casefold().split() == words]
        if self.scene is None:
            if not named:
                raise UsageError(
                    f"{asked.instruction!r} is no instruction of {self.suite}: in which scene?",
                    next="set scene = <index or name> in this section, or use a task's own words",
                )
            return named[0], named[0]
        where = choose_tasks(self.suite, [self.scene])[0]
        if named and not can_be_done_in(named[0], where):
            raise UsageError(
                f"{asked.instruction!r} cannot be done in the scene of {where.name}",
                next="leave scene out, or choose another one",
            )
        return where, named[0] if named else None
