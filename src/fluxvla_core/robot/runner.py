"""``BaseInferenceRunner``: a policy drives a robot, one task after the other, within limits.

A robot whose operator has the full contract needs no runner of its own. Runners written for
upstream FluxVLA override ``get_ros_observation``, ``update_observation_window`` and
``_execute_actions``; the commands that the latter gets have passed filters and limits already.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from fluxvla_core.build import (
    RunContext,
    bind_options,
    build_operator_from_cfg,
    build_policy_from_cfg,
    takes,
)
from fluxvla_core.contracts.check import check_policy
from fluxvla_core.contracts.frame import Frame
from fluxvla_core.contracts.policy import Policy
from fluxvla_core.contracts.robot import Operator
from fluxvla_core.contracts.runner import Runner
from fluxvla_core.control.interrupt import Interrupted, Interrupts
from fluxvla_core.control.joiners import ChunkJoiner, make_joiner
from fluxvla_core.control.safety import Latch, SafetySettings
from fluxvla_core.control.sender import ExecuteActions, check_pose
from fluxvla_core.control.tracking import TrackingWatch
from fluxvla_core.errors import ConfigError
from fluxvla_core.hooks import build_hooks
from fluxvla_core.plugins.registry import OPERATORS
from fluxvla_core.robot.engine import Engine, LocalEngine, RobotSession, RunHistory
from fluxvla_core.robot.episode import EpisodeParts, EpisodeSettings
from fluxvla_core.robot.events import Event, HookObserver
from fluxvla_core.robot.local_policy_client import LocalPolicyClient, PolicyThread
from fluxvla_core.robot.observations import ObservationReader
from fluxvla_core.robot.options import (
    InferenceOptions,
    build_filters,
    fit_cameras,
)
from fluxvla_core.robot.process.remote_engine import RemoteEngine
from fluxvla_core.robot.process.setup import ControlSetup, registered_here
from fluxvla_core.robot.process_layout import (
    ControlTables,
    ProcessLayout,
    RunnerOverrides,
    choose_layout,
)
from fluxvla_core.robot.recording.recorder import EpisodeRecorder
from fluxvla_core.robot.recording.ros_messages import typestore
from fluxvla_core.robot.recording.trace import next_folder
from fluxvla_core.robot.robot import Robot
from fluxvla_core.robot.tasks import Task, TaskSource, check_descriptions, task_source
from fluxvla_core.spec import EmbodimentSpec

Array = npt.NDArray[np.float64]
FOLDER = "inference"
_WAITED = 0.05
"""A run says so if the robot waits for its policy in a larger share of the control periods."""


class BaseInferenceRunner(Runner):
    """Runs a policy on a robot: ``run_setup()``, then ``run()``.

    Args:
        cfg: the whole config (injected).
        context: what the run knows (injected): work dir, task, reporter.
        **options: the settings, by the fields of ``InferenceOptions``.

    Raises:
        ConfigError, PluginError: the operator cannot be built, or the values do not fit it.
    """

    api: ClassVar[str] = "1.0"
    Options: ClassVar[type[InferenceOptions]] = InferenceOptions
    """The settings: its fields are the constructor's further keywords."""

    def __init__(
        self,
        cfg: Mapping[str, Any] | None = None,
        context: RunContext | None = None,
        **options: Any,
    ) -> None:
        self.cfg = cfg
        self.context = context or RunContext(config=cfg or {})
        name = type(self).__name__
        self.options = given = bind_options(self.Options, options, name, self.context)
        given.check(self.context)
        # Subclasses may change these when their constructor goes on.
        self.seed, self.prepare_pose = given.seed, given.prepare_pose
        self.max_publish_step, self.action_chunk = given.max_publish_step, given.action_chunk
        self.camera_names = None if given.camera_names is None else tuple(given.camera_names)
        self.task_descriptions = check_descriptions(given.task_descriptions)
        self.free_tasks = given.free_tasks or self.context.free_task
        self.policy: Any = build_policy_from_cfg(given.policy, context)
        self.chunk_joining = given.joining
        self.safety = SafetySettings.of(given.safety)
        self._layout = self._choose_layout(context)
        self.ros_operator, self.robot = self._layout.operator, self._layout.robot
        self.embodiment = self.robot.embodiment
        self.publish_rate = given.check_robot(self.robot, self.context)
        self.action_filters = build_filters(
            given.action_filters, given.gripper_threshold, self.embodiment, context
        )
        self.latch = Latch(self.robot.clock.now)
        self._frame: Frame | None = None
        self.recorder: EpisodeRecorder | None = None
        """The recorder of the last episode."""
        self._history = RunHistory()
        self._waiting_reported = False

    def _choose_layout(self, context: RunContext | None) -> ProcessLayout:
        """Choose which process commands the robot, and build this process's operator."""
        given, operator = self.options, self.options.operator
        if operator is None:
            raise ConfigError(
                f"{type(self).__name__} has no operator: which robot is it to drive?",
                where=self.context.where(self.context.section),
                next=f"--set '{self.context.section}.operator={{type = \"CLASS\"}}'; "
                "fluxvla plugins list shows the operators",
            )
        # A robot does not begin from a seed: configs that are for both leave it out of its table.
        scene = {"seed": self.seed} if takes(operator, OPERATORS, "seed") else {}
        table = {**scene, **operator} if isinstance(operator, Mapping) else operator
        layout = choose_layout(
            lambda: build_operator_from_cfg(operator, context, **scene),
            ControlTables(table, list(given.action_filters), given.gripper_threshold),
            self.context.config,
            given.embodiment,
            RunnerOverrides.of(type(self), BaseInferenceRunner, self.context),
            "control_process is False" if given.control_process is False else None,
        )
        if given.control_process and layout.why_single_process is not None:
            raise self.config_error("control_process", f"is True, and {layout.why_single_process}")
        return layout

    def run_setup(self) -> None:
        """Load the policy and check that it, the robot, the poses and the task fit together.

        Raises:
            CheckpointError: there is no policy to load.
            LoadFailed: the policy does not say what a robot has to know of it.
            SpecMismatch: the policy is for another robot, or for other views.
            ConfigError, UsageError: a pose, a camera or the task does not fit.
        """
        given = self.options
        if given.record is not None:
            typestore()  # before anything moves: what recording needs is installed
        if self.context.task is not None or self.context.task_file is not None:
            self._task_source()
        loaded = self.policy is None
        if loaded:
            from fluxvla_core.policies.loading import (
                find_checkpoint,
                load_policy,
                why_not_continued,
            )

            place = find_checkpoint(given.ckpt_path, self.context.work_dir)
            self.context.reporter.info(f"policy: {place}")
            why = why_not_continued(place) if self._continues_chunks else None
            if why is not None:
                raise self.config_error("chunk_joining", f"is {self.chunk_joining!r}, and {why}")
            self.policy = load_policy(
                place, given.device, given.dataset, given.denormalize_action,
                given.mixed_precision_dtype, given.execution, given.quantization,
                check=self._fit_cameras,
            )  # fmt: skip
        check_policy(self.policy)
        self.policy = Policy.adapt(self.policy)
        if self._continues_chunks and not self.policy.continues:
            raise self.config_error(
                "chunk_joining",
                f"is {self.chunk_joining!r}, and {type(self.policy).__name__} cannot continue a "
                "chunk: neither it nor its model takes what is left of the last one",
            )
        if not loaded:
            self._fit_cameras(self.policy.embodiment, tuple(self.policy.cameras))
        if self.prepare_pose is not None:
            check_pose(self.prepare_pose, self.embodiment)
        if not self.robot.can_stop:
            self.context.reporter.warn(
                f"{self.robot.name} has no stop(): it is stopped by commands that brake, and held "
                "by the last of them; a robot that does not hold its last command needs a stop()"
            )

    def _fit_cameras(self, trained: EmbodimentSpec, looks_at: tuple[str, ...]) -> None:
        """Check that a policy is for this robot; a checkpoint's before its model is built."""
        names, context = self.camera_names, self.context
        self._cameras = fit_cameras(trained, looks_at, self.embodiment, names, context)

    def run(self) -> dict[str, Any]:
        """Connect, do the tasks of the command line, of a person or of a topic, and stop.

        Returns:
            The last episode's task, outcome, success and steps, and how many there were.

        Raises:
            UsageError: there is no task, and nobody to ask for one; nothing was connected.
            KeyboardInterrupt: Ctrl-C; the robot was stopped.
            RunFailed: SIGTERM; the robot was stopped.
            Exception: what ended the run; the robot was stopped.
        """
        hooks = build_hooks(self.context)
        thread = PolicyThread("fluxvla-policy")
        ended, source = "failed", self._task_source()
        watched = self.robot.delays.watched(self.context.reporter.warn, self.safety.starvation_s)
        with Interrupts() as interrupts, watched:
            self._observers = (HookObserver(hooks),)
            self._engine = engine = self._make_engine(interrupts, thread)
            if self._layout.notice is not None:
                self.context.reporter.info(self._layout.notice)
            session = RobotSession(
                source, self.task_descriptions, self.free_tasks, engine, self.latch, interrupts,
                thread,
            )  # fmt: skip
            try:
                hooks.call("run_started", embodiment=self.embodiment)
                source.open()
                engine.connect()
                with engine.commanding():
                    for task in session.tasks():
                        summary = None
                        with session.episode(task):
                            summary = self._run_episode(task)
                        if summary is not None:
                            session.ended(task, summary)
                    result = session.result()
                ended = "ok"
            except Interrupted as signal:
                ended = "interrupted"
                raise signal.final(engine.stop_failure) from None
            finally:
                interrupts.stopping = True
                self._shut_down(thread)
                source.close()
                hooks.call("run_finished", outcome=ended)
        return result

    def episode_facts(self) -> Mapping[str, Any]:
        """JSON values that the operator reports about the last episode."""
        return self._engine.episode_facts()

    @property
    def divided(self) -> bool:
        """Whether a process of its own commands the robot."""
        return self._layout.tables is not None

    def get_ros_observation(self) -> tuple[Any, ...]:
        """The newest frame: one image for each of ``camera_names``, then the state.

        A subclass returns whatever its ``update_observation_window`` makes use of.
        """
        frame = self.robot.frame()
        self._frame = frame
        return (*(frame.images.get(name) for name in self._cameras), frame.state)

    def update_observation_window(self) -> dict[str, Any]:
        """The observation for the policy, without the instruction.

        Returns:
            ``qpos``: ``(state_dim,)`` float32, and ``images``: camera -> ``(H, W, 3)`` uint8 RGB. A
            stream that has not come yet is None.
        """
        *images, state = self.get_ros_observation()
        return {
            "qpos": None if state is None else np.asarray(state, dtype=np.float32),
            "images": dict(zip(self._cameras, images, strict=True)),
        }

    def _execute_actions(self, actions: Array, rate: Any) -> None:
        """Send ``(N, D)`` commands that are within all limits, one at each tick of ``rate``."""
        self.robot.send_actions(actions, rate)

    def control_side(
        self, robot: Robot, cameras: Sequence[str]
    ) -> tuple[ExecuteActions, Callable[[], tuple[dict[str, Any], Frame | None]]]:
        """The functions of this runner that the control process uses: it sends commands and
        observes.

        Called there; the runner was built without a policy.

        Args:
            robot: takes the place of this runner's.
            cameras: names of the cameras that the policy looks at.
        """
        self.robot, self._cameras = robot, tuple(cameras)
        return self._execute_actions, self._observe

    def _run_episode(self, task: Task) -> dict[str, Any]:
        """One task, from the start pose to the hold at its end; what ``episode.json`` holds."""
        assert self.policy is not None, "run_setup() comes before run()"
        reporter = self.context.reporter
        fps, folder = self.options.record_fps, self.options.record
        root = Path(self.context.work_dir) / FOLDER if folder is None else Path(folder)
        self.recorder = EpisodeRecorder(
            next_folder(root, task.name), self.robot, self.policy, self._cameras, fps,
            folder is not None, reporter,
        )  # fmt: skip
        reporter.info(f"task: {task.instruction}")
        number = self._history.episodes
        observers = (self.recorder, *self._observers)
        self._engine.run_episode(task, number, self.seed + number, observers, self.recorder.folder)
        self._history.episodes += 1
        self._report_waiting(self.recorder.summary)
        return self.recorder.summary

    def _report_waiting(self, summary: Mapping[str, Any]) -> None:
        """Say, once, that the robot need not wait for its policy, if it often did."""
        waited = summary["held_ticks"] / max(summary["steps"], 1)
        if waited > _WAITED and not self._waiting_reported and not self._joiner().streamed:
            self._waiting_reported = True
            self.context.reporter.info(
                f"the robot waited for the policy in {waited:.0%} of the control periods; "
                "chunk_joining = 'overlap' queries the policy while the robot moves"
            )

    def _make_engine(self, interrupts: Interrupts, thread: PolicyThread) -> Engine:
        """The engine of one run: ``RemoteEngine`` with a control process, else ``LocalEngine``.

        Args:
            interrupts: signals that ask the run to end.
            thread: the thread in which the policy computes.
        """
        robot, latch, history, layout = self.robot, self.latch, self._history, self._layout
        reporter, remote = self.context.reporter, layout.remote_operator
        observe = self._observe if remote is None or layout.runner is None else remote.observe

        def make_client(
            task: Task, seed: int, tracking: TrackingWatch, emit: Callable[[Event], None]
        ) -> LocalPolicyClient:
            reader = ObservationReader(
                robot, observe, task.instruction, self._cameras, self.safety,
                self.options.ready_timeout, tracking, thread.submit, interrupts, emit,
            )  # fmt: skip
            return LocalPolicyClient(reader, self.policy, seed, thread)

        settings, tables = self._episode_settings(), layout.tables
        if tables is None:
            parts = EpisodeParts(
                robot, make_client, self.action_filters, self._joiner(), self._execute_actions,
                latch, interrupts, reporter,
            )  # fmt: skip
            return LocalEngine(parts, settings, history)
        setup = ControlSetup(
            config=self.context.config,
            section=self.context.section,
            work_dir=str(self.context.work_dir),
            operator=tables.operator,
            embodiment=robot.embodiment.to_dict(),
            filters=tables.filters,
            gripper_threshold=tables.gripper_threshold,
            joining=self._joining(),
            settings=settings,
            before=history.commanded,
            python_path=sys.path,
            registered=registered_here(tables.operator, tables.filters, layout.runner),
            cameras=None if remote is None else self._cameras,
            runner=layout.runner,
        )
        return RemoteEngine(setup, robot, make_client, latch, interrupts, reporter, history, remote)

    def _episode_settings(self) -> EpisodeSettings:
        # Played in motion, a chunk is left when the next is there, not before.
        horizon = None if self._joiner().streamed else self.options.execute_horizon
        used = () if self.policy.whole_motion else (self.action_chunk, horizon)
        return EpisodeSettings(
            rate_hz=self.publish_rate,
            safety=self.safety,
            start_pose=self.prepare_pose,
            max_actions=min((n for n in used if n is not None), default=None),
            latency_s=self.options.simulated_latency,
            max_steps=self.max_publish_step,
            action_rate_hz=self.policy.action_rate_hz,
        )

    def _observe(self) -> tuple[dict[str, Any], Frame | None]:
        self._frame = None
        window = self.update_observation_window()
        return window, self._frame

    def _shut_down(self, thread: PolicyThread) -> None:
        reporter, engine = self.context.reporter, self._engine
        for problem in (engine.stop(), engine.close()):
            # A stop that failed at the episode's end fails here again.
            if problem and problem != engine.stop_failure:
                reporter.warn(problem)
        if not thread.close(1.0):
            hung = " and ".join(self.robot.delays.under_way()) or "the policy's thread"
            reporter.warn(f"{hung} still hangs; its thread ends with the program")

    def _task_source(self) -> TaskSource:
        domain_id = Operator.adapt(self.ros_operator).domain_id
        topic = self.options.task_topic
        return task_source(self.context, self.task_descriptions, topic, domain_id, self.free_tasks)

    @property
    def _continues_chunks(self) -> bool:
        """Whether chunks have to continue those before: real-time chunking."""
        return make_joiner(self.chunk_joining).continues

    def _joiner(self) -> ChunkJoiner:
        return make_joiner(*self._joining())

    def _joining(self) -> tuple[Any, float]:
        """The method, and how far apart observations are at least, from ``execute_horizon``."""
        assert self.policy is not None, "run_setup() comes before run()"
        least = self.options.execute_horizon or (1 if self.robot.lockstep else 0)
        return self.chunk_joining, least / self.policy.action_rate_hz

    def config_error(self, key: str, problem: str) -> ConfigError:
        """An error about a key of this section."""
        return self.context.error(key, problem)
