"""``LiberoEvalRunner``: LIBERO's protocol on the core's evaluation, with results that follow from
seeds alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from fluxvla_mujoco import RENDERS

from fluxvla_core.errors import ConfigError
from fluxvla_core.evaluation import EvalRunner
from fluxvla_core.operators import RunContext
from fluxvla_libero.embodiment import CAMERAS, CONTROL_HZ, SCENE_CAMERAS, dataset_spec
from fluxvla_libero.environment import FLUXVLA, OPENVLA
from fluxvla_libero.suites import NUM_STEPS_WAIT, check_suite, choose_tasks

TRIALS = 50
"""Fixed initial states of each task."""


class LiberoEvalRunner(EvalRunner):
    """Success of a policy on a LIBERO suite, by task, with intervals.

    The standard protocol: fixed initial states, 10 waiting steps, then at most 220, 280, 300, 520
    or 400 steps (spatial, object, goal, 10, 90); success is the environment's. Everything else is
    :class:`EvalRunner`'s: results that do not depend on the number of processes, resuming,
    parts of a job, videos.

    Args:
        cfg: the whole config (injected).
        context: what the run knows (injected): work dir, reporter.
        seed: of the policy; trial ``n`` uses ``seed + n``.
        model_family: no effect; upstream FluxVLA's configs have it, and it is written to
            ``results.json``.
        task_suite_name: libero_spatial, _object, _goal, _10, _90, or one of LIBERO-PRO's.
        tasks: which of the suite's, by index or name; all by default.
        eval_chunk_size: how many actions of a chunk are executed before the next query.
        resize_size: side of the policy's images, which are drawn in that size; as it was
            trained by default.
        num_trials_per_task: episodes for each task, from the first initial state on; at most 50.
        num_steps_wait: steps that the arm holds still before; they do not count.
        protocol: when LIBERO's random numbers start, which place what cannot move: ``fluxvla``
            before each episode, ``openvla`` once for a task, as OpenVLA's evaluation does. Results
            say which; see :class:`~fluxvla_libero.environment.LiberoEnvironment`.
        max_steps: instead of the suite's limit.
        mixed_precision_dtype, enable_mixed_precision_training: ``bf16`` inference, if enabled.
        instruction_swap: repeat every episode with the instruction of another task that could be
            done in the same scene, and test whether the right one does better.
        render: ``cheap`` images (no shadows, no multisampling), ``coarse`` ones (nor details),
            or LIBERO's own: ``reference``.
        video_fps: at most 20.
        **options: as ``EvalRunner`` takes them.

    Raises:
        ConfigError: a value is impossible.
    """

    api: ClassVar[str] = "1.0"
    robot_spec = staticmethod(dataset_spec)
    """The robot that both runners are for."""

    def __init__(
        self,
        cfg: Mapping[str, Any] | None = None,
        context: RunContext | None = None,
        *,
        seed: int = 7,
        model_family: str | None = None,
        task_suite_name: str = "libero_object",
        tasks: Sequence[int | str] | None = None,
        eval_chunk_size: int = 8,
        resize_size: int | None = None,
        num_trials_per_task: int = TRIALS,
        num_steps_wait: int = NUM_STEPS_WAIT,
        protocol: str = FLUXVLA,
        mixed_precision_dtype: str = "bf16",
        enable_mixed_precision_training: bool = False,
        render: str = "cheap",
        video_fps: float = 10.0,
        **options: Any,
    ) -> None:
        self.context = context or RunContext(config=cfg or {})
        try:
            check_suite(task_suite_name)
        except ConfigError as error:
            raise self.config_error("task_suite_name", f"is wrong: {error.what}") from error
        for name, value, known in (
            ("render", render, RENDERS),
            ("protocol", protocol, (FLUXVLA, OPENVLA)),
        ):
            if value not in known:
                raise self.config_error(
                    name, f"{value!r} is unknown; choose one of {', '.join(known)}"
                )
        if not 1 <= num_trials_per_task <= TRIALS:
            raise self.config_error(
                "num_trials_per_task", f"must be 1 to {TRIALS}, got {num_trials_per_task}"
            )
        if video_fps > CONTROL_HZ:
            raise self.config_error(
                "video_fps", f"must be at most {CONTROL_HZ:g}, got {video_fps:g}"
            )
        for name, number, least in (
            ("seed", seed, 0),
            ("eval_chunk_size", eval_chunk_size, 1),
            ("num_steps_wait", num_steps_wait, 0),
            ("resize_size", resize_size, 16),
        ):
            if number is not None and number < least:
                raise self.config_error(name, f"must be at least {least}, got {number}")
        self.model_family = model_family
        self._suite = task_suite_name
        self._chosen = tasks
        super().__init__(
            cfg=cfg,
            context=self.context,
            environment={
                "type": "LiberoEnvironment",
                "suite": task_suite_name,
                "cameras": tuple(CAMERAS),
                "render": render,
                "num_steps_wait": num_steps_wait,
                "protocol": protocol,
            },
            episodes=num_trials_per_task,
            seed=0,
            swap_seed=None,
            policy_seed=seed,
            live=False,
            replan_every=eval_chunk_size,
            video_cameras=SCENE_CAMERAS,
            video_height=256,
            video_width=256,
            video_fps=video_fps,
            height=resize_size,
            width=resize_size,
            mixed_precision_dtype=(
                mixed_precision_dtype if enable_mixed_precision_training else "float32"
            ),
            **options,
        )

    def run_setup(self) -> None:
        """Find LIBERO, the tasks, and the checkpoint.

        Raises:
            MissingPlugin, RunFailed: LIBERO is not installed, or does not work.
            ConfigError: the suite has no such task.
            CheckpointError: there is no checkpoint, or the one that is named is damaged.
        """
        self.task_names = tuple(task.name for task in choose_tasks(self._suite, self._chosen))
        super().run_setup()

    def identity(self) -> dict[str, Any]:
        """Everything that outcomes follow from, besides each episode's key, as JSON values."""
        about = super().identity()
        about["settings"]["task_suite_name"] = self._suite
        if self.model_family:
            about["settings"]["model_family"] = self.model_family
        return about
