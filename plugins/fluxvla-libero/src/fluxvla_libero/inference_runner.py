"""``LiberoInferenceRunner``: a policy does one task in a LIBERO scene, and everybody can watch."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

from fluxvla_mujoco import check_render

from fluxvla_core.errors import ConfigError, RunFailed, UsageError
from fluxvla_core.evaluation import (
    PolicySource,
    RolloutSettings,
    make_policy,
    match_policy,
    run_episode,
)
from fluxvla_core.operators import (
    Camera,
    EpisodeTrace,
    RunContext,
    Task,
    check_descriptions,
    next_folder,
    task_source,
    tasks,
)
from fluxvla_core.results import episode_log
from fluxvla_libero.embodiment import CAMERAS, CONTROL_HZ, SCENE_CAMERAS, dataset_spec
from fluxvla_libero.environment import LiberoEnvironment
from fluxvla_libero.eval_runner import TRIALS
from fluxvla_libero.suites import (
    NUM_STEPS_WAIT,
    SuiteTask,
    can_be_done_in,
    check_suite,
    choose_tasks,
)

FOLDER = "inference"


class LiberoInferenceRunner:
    """Runs a policy in one scene: ``run_setup()``, then ``run()``.

    ``--task`` names an id or an instruction of ``task_descriptions``; without it the suite's tasks
    are known, by their indices. Time is simulated. An
    episode goes as the trial of that number in ``LiberoEvalRunner``.

    Writes ``<work_dir>/inference/<NNN>-<task>/``: ``episode.json``, ``trace.jsonl``, a video for
    each camera of the scene.

    Args:
        cfg: the whole config (injected).
        context: what the run knows (injected): work dir, task, reporter.
        seed: of the policy, with that of the initial state added.
        ckpt_path: checkpoint or work dir; the newest undamaged one of the work dir by default.
        task_suite_name: whose scenes.
        scene: index or name of the task whose scene it is; by default that of the instruction.
        init_state: which of the scene's 50 fixed states it begins in.
        task_descriptions: id -> instruction.
        dataset, denormalize_action, norm_stats_key: see ``LiberoEvalRunner``.
        eval_chunk_size, resize_size, num_steps_wait, max_steps, render: see there.
        mixed_precision_dtype, enable_mixed_precision_training, execution, quantization: see there.
        policy: ``checkpoint``, ``expert``, ``untrained``, ``random``, or a registered one's table.
        live_port: also show the episode, while it happens, to any browser on this machine.
        video_size: side of the videos' images.
        record_fps: of the videos; must divide 20.
        device: of torch.
        free_tasks: allow other instructions, as ``--free-task`` does.

    Raises:
        ConfigError, UsageError: a value is impossible.
    """

    api: ClassVar[str] = "1.0"
    robot_spec = staticmethod(dataset_spec)
    """The robot that both runners are for."""

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
        execution: str = "eager",
        quantization: str | None = None,
        policy: str | Mapping[str, Any] = "checkpoint",
        render: str = "cheap",
        live_port: int | None = None,
        video_size: int = 256,
        record_fps: float = 20.0,
        device: str = "cpu",
        free_tasks: bool = False,
    ) -> None:
        self.context = context or RunContext(config=cfg or {})
        self.free_tasks = free_tasks or self.context.free_task
        check_suite(task_suite_name)
        check_render(render)
        if not 0 <= init_state < TRIALS:
            raise ConfigError(f"init_state must be 0 to {TRIALS - 1}, got {init_state}")
        if 20 % record_fps:
            raise ConfigError(f"record_fps must divide 20, got {record_fps:g}")
        self.suite = task_suite_name
        self.scene = scene
        self.init_state = init_state
        self.ckpt_path = ckpt_path
        self.task_descriptions = check_descriptions(task_descriptions)
        self.size = None if resize_size is None else (resize_size, resize_size)
        self.render = render
        self.live_port = live_port
        self.record_fps = record_fps
        self._wait = num_steps_wait
        self._videos = tuple(Camera(name, video_size, video_size) for name in SCENE_CAMERAS)
        self._rollout = RolloutSettings((), eval_chunk_size, max_steps, seed)
        self._source = PolicySource(
            policy=policy,
            ckpt_path=ckpt_path,
            dataset=dataset,
            denormalize_action=denormalize_action,
            norm_stats_key=norm_stats_key,
            device=device,
            precision=mixed_precision_dtype if enable_mixed_precision_training else "float32",
            execution=execution,
            quantization=quantization,
        )
        self._policy: Any = None

    def run_setup(self) -> None:
        """Load the policy and hold it against LIBERO's embodiment.

        Raises:
            MissingPlugin, RunFailed: LIBERO is not installed, or does not work.
            SpecMismatch: the policy's numbers mean something else than LIBERO's.
            CheckpointError: there is none, or the one that is named is damaged.
        """
        environment = self._environment(None)
        self._policy = make_policy(self._source.resolve(environment, self.context.work_dir))
        cameras = match_policy(self._policy, environment.spec, self.size)
        self._rollout = replace(self._rollout, cameras=cameras)

    def run(self) -> list[dict[str, Any]]:
        """Run an episode for each task that is asked for; returns their summaries.

        Raises:
            UsageError: the task is unknown, or cannot be done in the scene; or ``run_setup`` was
                not called.
            SpecMismatch: the policy's actions are of another shape.
            RunFailed: they are not finite, or recording failed.
        """
        if self._policy is None:
            raise UsageError("LiberoInferenceRunner: call run_setup() before run()")
        known = self.task_descriptions or {
            str(task.index): task.language for task in choose_tasks(self.suite, None)
        }
        source = task_source(self.context, known, free=self.free_tasks)
        with self._live() as show, closing(source):
            source.open()
            asked = tasks(source, known, lambda: time.sleep(0.05), free=self.free_tasks)
            return [self._episode(task, show) for task in asked]

    def _episode(self, asked: Task, show: Any) -> dict[str, Any]:
        where, task = self._resolve(asked)
        reporter = self.context.reporter
        reporter.info(f"{asked.instruction!r} in the scene of {where.name}")
        environment = self._environment(None if task is not None else asked.instruction)
        spec, body = environment.spec, environment.spec.embodiment
        folder = next_folder(Path(self.context.work_dir) / FOLDER, asked.name)
        record = _Record(EpisodeTrace(folder, self.record_fps), self._videos, show)
        record.write(
            episode_log.START,
            0.0,
            format=episode_log.FORMAT,
            task=asked.name,
            instruction=asked.instruction,
            seed=self._rollout.policy_seed,
            robot="LIBERO",
            embodiment=body.to_dict(),
            rate_hz=CONTROL_HZ,
            lockstep=True,
            native=False,
            began=time.time(),
        )
        about = {"scene": where.name, "init_state": self.init_state, "render": self.render}
        end: dict[str, Any] = {"outcome": "failed", "success": None, "problem": None}
        try:
            other = None if task in (None, where) else spec.task(task.name)
            found = run_episode(
                environment,
                self._policy,
                spec.task(where.name),
                self.init_state,
                self._rollout,
                other,
                record,
            )
            if found["problem"] is not None:
                end["problem"] = found["problem"]
                raise RunFailed(found["problem"], where=str(folder))
            success = None if task is None else found["behaviours"][task.name]
            end |= {"outcome": "done" if success else "ended", "success": success}
            about |= {"chunks": found["calls"], "state_hash": found["state_hash"]}
        finally:
            summary = record.close(end, about)
            environment.close()
        word = {True: "success", False: "no success", None: "success unknown"}[success]
        reporter.info(f"{word} after {found['steps']} steps")
        reporter.artifact("episode", folder)
        return summary

    def _environment(self, instruction: str | None) -> LiberoEnvironment:
        return LiberoEnvironment(
            suite=self.suite,
            cameras=tuple(CAMERAS),
            render=self.render,
            num_steps_wait=self._wait,
            instruction=instruction,
        )

    @contextmanager
    def _live(self) -> Iterator[Any]:
        """A function that shows images side by side; it does nothing without a live view."""
        if self.live_port is None:
            yield lambda images: None
            return
        import numpy as np

        from fluxvla_libero.live_view import LiveView

        with LiveView(self.live_port) as view:
            self.context.reporter.info(f"live at {view.url}")
            yield lambda images: view.show(np.hstack(images))

    def _resolve(self, asked: Task) -> tuple[SuiteTask, SuiteTask | None]:
        """The scene, and the suite's task of these words if there is one."""
        words = asked.instruction.casefold().split()
        named = [
            t for t in choose_tasks(self.suite, None) if t.language.casefold().split() == words
        ]
        if self.scene is None:
            if not named:
                raise UsageError(
                    f"{asked.instruction!r} is not an instruction of {self.suite}: in which scene?",
                    next=f"--set {self.context.section}.scene=<index or name>, "
                    "or use a task's own words",
                )
            return named[0], named[0]
        (where,) = choose_tasks(self.suite, [self.scene])
        if named and named[0] != where and not can_be_done_in(named[0], where):
            raise UsageError(
                f"{asked.instruction!r} cannot be done in the scene of {where.name}",
                next="leave scene out, or choose another one",
            )
        return where, named[0] if named else None


class _Record:
    """Writes an episode in the format of a robot's: called at every step, then closed."""

    def __init__(
        self,
        trace: EpisodeTrace,
        cameras: Sequence[Camera],
        show: Callable[[list[Any]], None],
    ) -> None:
        self._trace, self._cameras, self._show = trace, cameras, show
        self._summary = episode_log.EpisodeSummary()
        self._stride = round(CONTROL_HZ / (trace.video_fps or CONTROL_HZ))
        self._t = 0.0

    def write(self, kind: str, t: float, **fields: Any) -> None:
        """One event at ``t`` seconds; arrays must not change afterwards."""
        event = {"event": kind, "t": t, **fields}
        self._trace.write(event)
        self._summary.add(event)
        self._t = t

    def __call__(self, world: Any, steps: int) -> None:
        if steps:
            sent, t = {"command": world.action, "state": world.state}, steps / CONTROL_HZ
            self.write(episode_log.COMMAND, t, phase="run", clamps=[], **sent)
        if steps % self._stride == 0:
            images = world.observe(self._cameras)["images"]
            self._trace.frames(images)
            self._show(list(images.values()))

    def close(self, end: Mapping[str, Any], about: Mapping[str, Any]) -> dict[str, Any]:
        """Write the ``end`` event and ``episode.json``, which has ``about`` too; what it holds."""
        self.write(episode_log.END, self._t, **end)
        return self._trace.close({**self._summary.to_dict(), **about})
