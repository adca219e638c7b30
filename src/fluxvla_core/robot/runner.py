"""``BaseInferenceRunner``: a policy drives a robot, one task after the other, within limits.

A robot whose operator has the full contract needs no runner of its own. Runners written for
upstream FluxVLA override ``get_ros_observation``, ``update_observation_window`` and
``_execute_actions``; the commands that the latter gets have passed filters and limits already.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from fluxvla_core.build import (
    RunContext,
    build_operator_from_cfg,
    build_policy_from_cfg,
    takes,
)
from fluxvla_core.contracts.check import check_policy
from fluxvla_core.contracts.frame import Frame
from fluxvla_core.contracts.policy import Policy
from fluxvla_core.contracts.robot import Operator
from fluxvla_core.contracts.runner import Runner
from fluxvla_core.errors import ConfigError
from fluxvla_core.hooks import build_hooks
from fluxvla_core.plugins.registry import OPERATORS
from fluxvla_core.robot.control.interrupt import Interrupted, Interrupts
from fluxvla_core.robot.control.joiners import ChunkJoiner, make_joiner
from fluxvla_core.robot.control.safety import Latch, SafetySettings
from fluxvla_core.robot.control.sender import Execute, check_pose
from fluxvla_core.robot.engine import Engine, RunHistory
from fluxvla_core.robot.episode import EpisodeSettings
from fluxvla_core.robot.events import HookObserver
from fluxvla_core.robot.make_engine import RunParts, make_engine
from fluxvla_core.robot.observation import fit_cameras
from fluxvla_core.robot.policy_calls import PolicyThread
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
from fluxvla_core.robot.session import RobotSession
from fluxvla_core.robot.settings import (
    build_filters,
    check_latency,
    check_state_dim,
    checked_joining,
    checked_rate,
)
from fluxvla_core.robot.tasks import Task, TaskSource, check_descriptions, task_source
from fluxvla_core.spec.embodiment import EmbodimentSpec

Array = npt.NDArray[np.float64]
FOLDER = "inference"


class BaseInferenceRunner(Runner):
    """Runs a policy on a robot: ``run_setup()``, then ``run()``.

    Args:
        cfg: the whole config (injected).
        context: what the run knows (injected): work dir, task, reporter.
        seed: of the policy's noise; episode ``n`` uses ``seed + n``. Also of a simulated operator
            whose table says no other.
        ckpt_path: checkpoint or work dir; the newest whole one of the work dir by default.
        dataset, denormalize_action: instead of what the checkpoint says, see ``load_policy``.
        policy: table or object of the Policy contract, instead of a checkpoint.
        task_descriptions: id -> instruction; what ``--task`` may name, by either.
        free_tasks: allow instructions that are none of ``task_descriptions``, as ``--free-task``
            does; the policy may do anything then.
        task_topic: ROS 2 topic (``std_msgs/String``) that tasks come from if the command line
            names none; by default a person at the terminal is asked.
        state_dim: checked against the robot's state, if given.
        action_chunk: how many of a chunk's actions may be used; all by default.
        publish_rate: commands a second; the embodiment's rate by default.
        max_publish_step: commands after which an episode ends.
        camera_names: the cameras that are observed; those that the policy looks at by default.
        operator: table or object.
        prepare_pose: where the arm goes before an episode, in the embodiment's units.
        embodiment: of an operator that has none, or narrower limits for one that has.
        execute_horizon: how many actions of a chunk are executed before the next is asked for.
            By default all of them; while chunks are joined in motion, as few as the policy is
            quick enough for (one, in a simulation whose time stands still meanwhile).
        async_execution: think while moving: short for ``chunk_joining="latest_only"``.
        chunk_joining: how chunks become one motion: a name of ``METHODS`` in
            ``robot.control.joiners``, or a table with ``method = '<name>'`` and its parameters.
            ``synchronous`` by default.
        simulated_latency: seconds from an observation to its chunk, in a simulation whose time
            stands still while the policy thinks: how the same policy would do on a slower computer.
        gripper_threshold: gripper targets nearer to closed than this close the gripper wholly, so
            that it presses on what it holds; in the gripper's unit. None leaves them as they are.
        action_filters: tables or callables that may alter an action, in order, before the limits.
        safety: thresholds, see ``SafetySettings``.
        mixed_precision_dtype: ``float32`` or ``bf16``.
        device: the torch device of the policy.
        execution, quantization: how its model computes, see ``load_policy``.
        record: folder for complete recordings, which ``ReplayOperator`` and ``ReplayPolicy`` play
            and Foxglove and ROS 2 open; by default an episode leaves its events and videos in the
            work dir.
        record_fps: frames a second of the recorded videos, and of a simulation's recorded
            pictures; None records none.
        ready_timeout: seconds that the robot may take to give its first reading.
        control_process: let a process of its own command the robot, so that nothing that the
            policy or a hook does keeps the arm from being held. By default wherever that is
            possible (docs/control.md). An operator that cannot be divided
            (``Operator.without_cameras``) runs there as a whole, its pictures included.

    Raises:
        ConfigError, PluginError: the operator cannot be built, or the values do not fit it.
    """

    api: ClassVar[str] = "1.0"

    def __init__(
        self,
        cfg: Mapping[str, Any] | None = None,
        context: RunContext | None = None,
        seed: int = 7,
        ckpt_path: str | None = None,
        dataset: Any = None,
        denormalize_action: Any = None,
        policy: Any = None,
        task_descriptions: Mapping[str, str] | None = None,
        task_topic: str | None = None,
        state_dim: int | None = None,
        action_chunk: int | None = None,
        publish_rate: float | None = None,
        max_publish_step: int = 10000,
        camera_names: Sequence[str] | None = None,
        operator: Any = None,
        prepare_pose: Sequence[float] | None = None,
        embodiment: EmbodimentSpec | Mapping[str, Any] | None = None,
        execute_horizon: int | None = None,
        async_execution: bool = False,
        chunk_joining: str | Mapping[str, Any] | None = None,
        simulated_latency: float = 0.0,
        gripper_threshold: float | None = None,
        action_filters: Sequence[Any] = (),
        safety: Mapping[str, Any] | None = None,
        mixed_precision_dtype: str = "float32",
        device: str = "cpu",
        execution: str = "eager",
        quantization: str | None = None,
        record: str | None = None,
        record_fps: float | None = 10.0,
        ready_timeout: float = 10.0,
        free_tasks: bool = False,
        control_process: bool | None = None,
    ) -> None:
        self.cfg = cfg
        self.context = context or RunContext(config=cfg or {})
        self.seed = seed
        self.ckpt_path = ckpt_path
        self.dataset = dataset
        self.denormalize_action = denormalize_action
        self.policy: Any = build_policy_from_cfg(policy, context)
        self.task_descriptions = check_descriptions(task_descriptions)
        self.free_tasks = free_tasks or self.context.free_task
        self.task_topic = task_topic
        self.action_chunk = action_chunk
        self.execute_horizon = execute_horizon
        self.max_publish_step = max_publish_step
        self.camera_names = None if camera_names is None else tuple(camera_names)
        self.prepare_pose = prepare_pose
        self.async_execution = async_execution
        self.chunk_joining = checked_joining(chunk_joining, async_execution, self.config_error)
        self.simulated_latency = simulated_latency
        self.gripper_threshold = gripper_threshold
        self.mixed_precision_dtype = mixed_precision_dtype
        self.device = device
        self.execution, self.quantization = execution, quantization
        self.record = record
        self.record_fps = record_fps
        self.ready_timeout = ready_timeout
        self.safety = SafetySettings.of(safety)
        self._layout = self._choose_layout(
            operator, action_filters, embodiment, control_process, context
        )
        self.ros_operator, self.robot = self._layout.operator, self._layout.robot
        self.embodiment = self.robot.embodiment
        wrong = self.config_error
        self.publish_rate = checked_rate(publish_rate, self.robot, wrong)
        check_state_dim(state_dim, self.embodiment, wrong)
        check_latency(simulated_latency, self.robot, wrong)
        self.action_filters = build_filters(
            action_filters, gripper_threshold, self.embodiment, context
        )
        self.latch = Latch(self.robot.clock.now)
        self._frame: Frame | None = None
        self.recorder: EpisodeRecorder | None = None
        """The recorder of the last episode."""
        self._history = RunHistory()

    def _choose_layout(
        self,
        operator: Any,
        action_filters: Sequence[Any],
        embodiment: EmbodimentSpec | Mapping[str, Any] | None,
        control_process: bool | None,
        context: RunContext | None,
    ) -> ProcessLayout:
        """Choose which process commands the robot, and build this process's operator."""
        if operator is None:
            raise ConfigError(
                f"{type(self).__name__} has no operator: which robot is it to drive?",
                where=self.context.where(self.context.section),
                next=f"--set '{self.context.section}.operator={{type = \"CLASS\"}}'; "
                "fluxvla plugins list shows the operators",
            )
        for name in ("action_chunk", "execute_horizon", "max_publish_step"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise self.config_error(name, f"must be at least 1, got {value}")
        # A robot does not begin from a seed: configs that are for both leave it out of its table.
        scene = {"seed": self.seed} if takes(operator, OPERATORS, "seed") else {}
        table = {**scene, **operator} if isinstance(operator, Mapping) else operator
        layout = choose_layout(
            lambda: build_operator_from_cfg(operator, context, **scene),
            ControlTables(table, list(action_filters), self.gripper_threshold),
            self.context.config,
            embodiment,
            RunnerOverrides.of(type(self), BaseInferenceRunner, self.context),
            "control_process is False" if control_process is False else None,
        )
        if control_process and layout.why_single_process is not None:
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
        if self.record is not None:
            typestore()  # before anything moves: what recording needs is installed
        if self.context.task is not None or self.context.task_file is not None:
            self._task_source()
        if self.policy is None:
            from fluxvla_core.policies.loading import find_checkpoint, load_policy

            place = find_checkpoint(self.ckpt_path, self.context.work_dir)
            self.context.reporter.info(f"policy: {place}")
            self.policy = load_policy(
                place, self.device, self.dataset, self.denormalize_action,
                self.mixed_precision_dtype, self.execution, self.quantization,
            )  # fmt: skip
        check_policy(self.policy)
        self.policy = Policy.adapt(self.policy)
        if self._joiner().continues and not self.policy.continues:
            raise self.config_error(
                "chunk_joining",
                f"is {self.chunk_joining!r}, and {type(self.policy).__name__} cannot continue a "
                "chunk: neither it nor its model takes what is left of the last one",
            )
        chosen, error, reporter = self.camera_names, self.config_error, self.context.reporter
        self._cameras = fit_cameras(self.policy, self.embodiment, chosen, error, reporter)
        if self.prepare_pose is not None:
            check_pose(self.prepare_pose, self.embodiment)
        if not self.robot.can_stop:
            reporter.warn(
                f"{self.robot.name} has no stop(): it is stopped by commands that brake, and held "
                "by the last of them; a robot that does not hold its last command needs a stop()"
            )

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
            engine = self._engine(interrupts, thread)
            if self._layout.notice is not None:
                self.context.reporter.info(self._layout.notice)
            self._session = session = RobotSession(
                source, self.task_descriptions, self.free_tasks, self.seed, self._history,
                engine, self.latch, interrupts, thread,
            )  # fmt: skip
            try:
                hooks.call("run_started", embodiment=self.embodiment)
                source.open()
                engine.connect()
                with engine.commanding():
                    result = session.run(self._run_episode)
                ended = "ok"
            except Interrupted as signal:
                ended = "interrupted"
                raise signal.final() from None
            finally:
                interrupts.stopping = True
                self._shut_down(session)
                source.close()
                hooks.call("run_finished", outcome=ended)
        return result

    def episode_facts(self) -> Mapping[str, Any]:
        """JSON values that the operator tells of the last episode."""
        return self._session.engine.episode_facts()

    @property
    def divided(self) -> bool:
        """Whether a process of its own commands the robot."""
        return self._layout.tables is not None

    def get_ros_observation(self) -> tuple[Any, ...]:
        """The newest reading: one picture for each of ``camera_names``, then the state.

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
        self.robot.play(actions, rate)

    def control_side(
        self, robot: Robot, cameras: Sequence[str]
    ) -> tuple[Execute, Callable[[], tuple[dict[str, Any], Frame | None]]]:
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
        root = Path(self.context.work_dir) / FOLDER if self.record is None else Path(self.record)
        self.recorder = EpisodeRecorder(
            next_folder(root, task.name), self.robot, self.policy, self._cameras, self.record_fps,
            self.record is not None, reporter,
        )  # fmt: skip
        reporter.info(f"task: {task.instruction}")
        self._session.play(task, (self.recorder, *self._observers), self.recorder.folder)
        return self.recorder.summary

    def _engine(self, interrupts: Interrupts, thread: PolicyThread) -> Engine:
        """The engine of one run."""
        policy = self.policy
        assert policy is not None, "run_setup() comes before run()"
        # Played in motion, a chunk is left when the next is there, not before.
        horizon = None if self._joiner().streamed else self.execute_horizon
        used = () if policy.whole_motion else (self.action_chunk, horizon)
        settings = EpisodeSettings(
            rate_hz=self.publish_rate,
            safety=self.safety,
            start_pose=self.prepare_pose,
            max_actions=min((n for n in used if n is not None), default=None),
            latency_s=self.simulated_latency,
            max_steps=self.max_publish_step,
            action_rate_hz=policy.action_rate_hz,
        )
        parts = RunParts(
            robot=self.robot,
            policy=policy,
            observe=self._observe,
            cameras=self._cameras,
            ready_s=self.ready_timeout,
            filters=self.action_filters,
            joining=self._joining(),
            execute=self._execute_actions,
            settings=settings,
            latch=self.latch,
            context=self.context,
            history=self._history,
        )
        return make_engine(parts, self._layout, interrupts, thread)

    def _observe(self) -> tuple[dict[str, Any], Frame | None]:
        self._frame = None
        window = self.update_observation_window()
        return window, self._frame

    def _shut_down(self, session: RobotSession) -> None:
        reporter = self.context.reporter
        engine = session.engine
        for problem in (engine.stop(), engine.close()):
            # A stop that failed at the episode's end fails here again.
            if problem and problem != engine.stop_failure:
                reporter.warn(problem)
        if not session.thread.close(1.0):
            hung = " and ".join(self.robot.delays.under_way()) or "the policy's thread"
            reporter.warn(f"{hung} still hangs; its thread ends with the program")

    def _task_source(self) -> TaskSource:
        domain_id = Operator.adapt(self.ros_operator).domain_id
        return task_source(
            self.context, self.task_descriptions, self.task_topic, domain_id, self.free_tasks
        )

    def _joiner(self) -> ChunkJoiner:
        return make_joiner(*self._joining())

    def _joining(self) -> tuple[Any, float]:
        """The method, and how far apart observations are at least, from ``execute_horizon``."""
        assert self.policy is not None, "run_setup() comes before run()"
        least = self.execute_horizon or (1 if self.robot.lockstep else 0)
        return self.chunk_joining, least / self.policy.action_rate_hz

    def config_error(self, key: str, what: str) -> ConfigError:
        """An error about a key of this section."""
        section = self.context.section
        return ConfigError(f"{key} {what}", where=self.context.where(f"{section}.{key}"))
