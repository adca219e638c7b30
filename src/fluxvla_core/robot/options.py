"""The settings of an inference runner, their checks against its robot, and its action filters."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fluxvla_core.build import RunContext, build_action_filter_from_cfg
from fluxvla_core.contracts.robot import ActionFilter
from fluxvla_core.control.filters import SnapGripper
from fluxvla_core.control.joiners import make_joiner
from fluxvla_core.errors import ConfigError, SpecMismatch
from fluxvla_core.robot.robot import Robot
from fluxvla_core.spec import EmbodimentSpec, check_match


@dataclass(frozen=True, kw_only=True)
class InferenceOptions:
    """The settings of an inference runner; its constructor and ``plugins show`` are made from
    them."""

    operator: Any = None
    """table or object: the robot."""
    embodiment: EmbodimentSpec | Mapping[str, Any] | None = None
    """of an operator that has none, or narrower limits for one that has."""
    control_process: bool | None = None
    """let a process of its own command the robot, so that nothing that the policy or a hook does
    keeps the arm from being held. By default wherever that is possible (docs/control.md). An
    operator that cannot be divided (``Operator.without_cameras``) runs there as a whole, its
    images included."""
    ready_timeout: float = 10.0
    """seconds that the robot may take to give its first frame."""

    policy: Any = None
    """table or object of the Policy contract, instead of a checkpoint."""
    ckpt_path: str | None = None
    """checkpoint or work dir; the newest undamaged one of the work dir by default."""
    dataset: Any = None
    """instead of what the checkpoint says, see ``load_policy``."""
    denormalize_action: Any = None
    """instead of what the checkpoint says, see ``load_policy``."""
    device: str = "cpu"
    """the torch device of the policy."""
    mixed_precision_dtype: str = "float32"
    """``float32`` or ``bf16``."""
    execution: str = "eager"
    """how the policy's model computes, see ``load_policy``."""
    quantization: str | None = None
    """how the policy's model computes, see ``load_policy``."""
    seed: int = 7
    """of the policy's noise; episode ``n`` uses ``seed + n``. Also of a simulated operator whose
    table says no other."""
    camera_names: Sequence[str] | None = None
    """the cameras that are observed; those that the policy looks at by default."""
    state_dim: int | None = None
    """checked against the robot's state, if given."""

    task_descriptions: Mapping[str, str] | None = None
    """id -> instruction; what ``--task`` may name, by either."""
    free_tasks: bool = False
    """allow instructions that are none of ``task_descriptions``, as ``--free-task`` does; the
    policy may do anything then."""
    task_topic: str | None = None
    """ROS 2 topic (``std_msgs/String``) that tasks come from if the command line names none; by
    default a person at the terminal is asked."""

    prepare_pose: Sequence[float] | None = None
    """where the arm goes before an episode, in the embodiment's units."""
    publish_rate: float | None = None
    """commands a second; the embodiment's rate by default."""
    max_publish_step: int = 10000
    """commands after which an episode ends."""
    action_chunk: int | None = None
    """how many of a chunk's actions may be used; all by default. An upper bound of
    ``execute_horizon``."""
    execute_horizon: int | None = None
    """how many actions of a chunk are executed before the next is asked for. By default all of
    them; while chunks are joined in motion, as few as the policy is quick enough for (one, in a
    simulation whose time stands still meanwhile)."""
    async_execution: bool = False
    """run inference while the arm moves: short for ``chunk_joining="latest_only"``."""
    chunk_joining: str | Mapping[str, Any] | None = None
    """how chunks become one motion: a name of ``METHODS`` in ``control.joiners``, or a table
    with ``method = '<name>'`` and its parameters. ``synchronous`` by default."""
    simulated_latency: float = 0.0
    """seconds from an observation to its chunk, in a simulation whose time stands still while the
    policy thinks: how the same policy would do on a slower computer."""
    gripper_threshold: float | None = None
    """gripper targets nearer to closed than this close the gripper wholly, so that it presses on
    what it holds; in the gripper's unit. None leaves them as they are."""
    action_filters: Sequence[Any] = ()
    """tables or callables that may alter an action, in order, before the limits."""
    safety: Mapping[str, Any] | None = None
    """thresholds, see ``SafetySettings``."""

    record: str | None = None
    """folder for complete recordings, which ``ReplayOperator`` and ``ReplayPolicy`` play and
    Foxglove and ROS 2 open; by default an episode leaves its events and videos in the work dir."""
    record_fps: float | None = 10.0
    """frames a second of the recorded videos, and of a simulation's recorded images; None records
    none."""

    def check(self, context: RunContext) -> None:
        """Refuse values that no run can have.

        Raises:
            ConfigError: with the place of its key.
        """
        for name, value in (
            ("action_chunk", self.action_chunk),
            ("execute_horizon", self.execute_horizon),
            ("max_publish_step", self.max_publish_step),
        ):
            if value is not None and value < 1:
                raise context.error(name, f"must be at least 1, got {value}")
        try:
            joiner = make_joiner(self.joining)
        except ConfigError as error:
            raise context.error("chunk_joining", error.what) from error
        if self.async_execution and not joiner.streamed:
            raise context.error(
                "chunk_joining", f"is {self.chunk_joining!r}, and async_execution is set"
            )

    def check_robot(self, robot: Robot, context: RunContext) -> float:
        """Refuse values that do not fit the robot; commands a second (``publish_rate``).

        Raises:
            ConfigError: with the place of its key.
        """
        spec, latency = robot.embodiment, self.simulated_latency
        rate = spec.rate_hz if self.publish_rate is None else float(self.publish_rate)
        if not 0 < rate <= spec.rate_hz:
            raise context.error(
                "publish_rate",
                f"is {rate:g} Hz; {spec.name} takes up to {spec.rate_hz:g} commands a second",
            )
        if robot.lockstep and rate != spec.rate_hz:
            raise context.error(
                "publish_rate",
                f"is {rate:g} Hz, but each command to this simulation lasts 1/{spec.rate_hz:g} s",
            )
        if self.state_dim is not None and self.state_dim != spec.state_dim:
            raise context.error(
                "state_dim", f"is {self.state_dim}; {spec.name} has {spec.state_dim} state values"
            )
        if not 0.0 <= latency < math.inf:
            raise context.error("simulated_latency", f"must be 0 or more, got {latency}")
        if latency and not robot.lockstep:
            raise context.error("simulated_latency", "is for simulations; this robot has its own")
        return rate

    @property
    def joining(self) -> str | Mapping[str, Any]:
        """``chunk_joining``, or its default."""
        if self.chunk_joining is not None:
            return self.chunk_joining
        return "latest_only" if self.async_execution else "synchronous"


def fit_cameras(
    trained: EmbodimentSpec,
    looks_at: tuple[str, ...],
    embodiment: EmbodimentSpec,
    chosen: tuple[str, ...] | None,
    context: RunContext,
) -> tuple[str, ...]:
    """Check that a policy is for a robot; the names of the cameras to observe.

    Args:
        trained: the robot that the policy was trained for; looks_at: names of its cameras.
        embodiment: the robot's.
        chosen: the config's ``camera_names``; None for those that the policy looks at.
        context: of the run; its reporter warns of images that are scaled.

    Raises:
        SpecMismatch: the policy is for another robot, or for other views.
        ConfigError: ``camera_names`` does not fit.
    """
    cameras = chosen or looks_at
    check_match(trained, embodiment, "the policy", "the robot", looks_at)
    known = embodiment.camera_names
    for name in (*cameras, *looks_at):
        if name not in known:
            raise context.error(
                "camera_names", f"{name!r} is unknown; choose one of {', '.join(known)}"
            )
        if name not in cameras:
            raise context.error("camera_names", f"the policy looks at {name!r} too")
    for warning in _scaled_views(trained, embodiment, looks_at):
        context.reporter.warn(warning)
    return cameras


def _scaled_views(trained: EmbodimentSpec, here: EmbodimentSpec, names: Sequence[str]) -> list[str]:
    """Check that a robot's cameras show what the policy was trained on, perhaps larger.

    A camera may have more pixels than in training; it may not show another view.

    Args:
        trained, here: the embodiments of the policy and of the robot.
        names: the cameras that the policy looks at.

    Returns:
        Warnings about images that are scaled.

    Raises:
        SpecMismatch: a camera's images have another aspect.
    """
    cameras = {camera.name: camera for camera in here.cameras}
    warnings = []
    for then in trained.cameras:
        now = cameras.get(then.name)
        if then.name not in names or now is None:
            continue
        if (now.height, now.width) == (then.height, then.width):
            continue
        sizes = (
            f"camera {then.name} gives {now.height} x {now.width} images; the policy was "
            f"trained on {then.height} x {then.width}"
        )
        difference = abs(now.width * then.height - then.width * now.height)
        if difference > 0.01 * now.height * then.width:
            raise SpecMismatch(
                f"{sizes}: another view",
                next="set the camera to the size, or at least the aspect, of the recordings",
            )
        warnings.append(f"{sizes}; they are scaled")
    return warnings


def build_filters(
    tables: Sequence[Any],
    gripper_threshold: float | None,
    embodiment: EmbodimentSpec,
    context: RunContext | None,
) -> list[ActionFilter]:
    """The action filters of a run, in order, bound to the robot.

    Args:
        tables: the config's ``action_filters``: tables or callables.
        gripper_threshold: of a ``SnapGripper`` after them, right before the limits; None for none.
        embodiment: of the robot.
        context: of the run.

    Raises:
        ConfigError, PluginError: one of them cannot be built, or does not fit the robot.
    """
    built = [build_action_filter_from_cfg(each, context) for each in tables]
    filters = [ActionFilter.adapt(each) for each in built]
    if gripper_threshold is not None:
        filters.append(SnapGripper(gripper_threshold))
    for each in filters:
        each.bind(embodiment)
    return filters
