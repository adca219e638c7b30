"""Live (real-time) evaluation: the simulation does not wait for the policy's inference.

In a stepped episode simulated time stands still during inference; on a robot it does not. Here the
environment is driven like a robot, by the inference runner with its control loop and its safety:
the simulation advances at its control rate on the wall clock, holds the last command while none
comes, and a slow policy misses ticks. Such an outcome depends on the machine and cannot be repeated
exactly, so it is never counted together with stepped ones.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from fluxvla_core.build import RunContext
from fluxvla_core.contracts.environment import Environment, Step, TaskSpec
from fluxvla_core.contracts.frame import STATE, Frame, Observation
from fluxvla_core.contracts.policy import Actor, Continuation, Policy
from fluxvla_core.contracts.robot import Operator
from fluxvla_core.control.clock import MonotonicClock
from fluxvla_core.control.joiners import make_joiner
from fluxvla_core.errors import ConfigError, SafetyStop
from fluxvla_core.evaluation.rollout import check_step
from fluxvla_core.ros2 import checked_action
from fluxvla_core.spec import Camera, EmbodimentSpec

Array = npt.NDArray[np.float64]

LIVE_OPTIONS = (
    "action_chunk",
    "action_filters",
    "chunk_joining",
    "execute_horizon",
    "gripper_threshold",
    "safety",
)
"""Keys of an evaluation's ``live`` table: arguments of an inference runner that say how a policy
drives a robot."""


@dataclass(frozen=True)
class LiveSettings:
    """Settings of live episodes.

    Args:
        options: arguments of ``BaseInferenceRunner``, of those in ``LIVE_OPTIONS``.
        folder: parent of the episodes' recordings.
        video_fps: frames a second of the videos; None records none.
    """

    options: Mapping[str, Any]
    folder: str
    video_fps: float | None = None


def live_options(live: bool | Mapping[str, Any]) -> dict[str, Any] | None:
    """The options of a live evaluation, None for a stepped one.

    ``chunk_joining`` is ``latest_only`` by default: the newest chunk replaces the one before.

    Raises:
        ConfigError: there is no such option.
    """
    if live is False:
        return None
    given = {} if live is True else dict(live)
    unknown = sorted(set(given) - set(LIVE_OPTIONS))
    if unknown:
        raise ConfigError(f"takes no {', '.join(unknown)}; it takes {', '.join(LIVE_OPTIONS)}")
    return {"chunk_joining": "latest_only", **given}


class EnvironmentOperator(Operator):
    """An environment as a robot in real time.

    Physics is stepped in whole control periods as they become due, at each reading and each
    command; the last command holds. Time begins with the first command, when the policy is warm.

    Args:
        environment: takes joint targets (``spec.limited``).
        actor: its ``enter`` is called with the environment when an episode begins.
        cameras: what ``get_frame`` shows.

    Attributes:
        ticks: control periods that have passed.
        late: those of them that were stepped together with others, because no call came in time.
        failed: the error of the environment that ended the episode, if one did.
    """

    api: ClassVar[str] = "1.0"
    embodiment: EmbodimentSpec
    clock: MonotonicClock

    def __init__(
        self,
        environment: Environment,
        actor: Actor,
        task: TaskSpec,
        seed: int,
        cameras: tuple[Camera, ...],
        max_steps: int,
    ) -> None:
        environment, actor = Environment.adapt(environment), Actor.adapt(actor)
        self.embodiment = replace(environment.spec.embodiment, cameras=cameras)
        self.clock = MonotonicClock()
        self.ticks = self.late = 0
        self.failed: Exception | None = None
        self._environment = environment
        self._actor = actor
        self._task, self._seed, self._limit = task, seed, max_steps
        self._period = 1.0 / self.embodiment.rate_hz
        self._lock = threading.RLock()
        self._began: float | None = None
        self._target: Array | None = None
        self._last_step: Step | None = None

    def connect(self) -> None:
        """Nothing: ``begin_episode`` resets."""

    def begin_episode(self, instruction: str, episode: int) -> None:
        """Reset the environment; called by the runner."""
        with self._lock:
            self._environment.reset(self._seed, self._task.name)
            self._actor.enter(self._environment)
            self._began = self._target = self._last_step = None
            self.ticks = self.late = 0

    def get_frame(self) -> Frame:
        """State and images of this moment."""
        with self._lock:
            self._catch_up()
            now = self.clock.now()
            images = self._environment.observe(self.embodiment.cameras)["images"]
            stamps = dict.fromkeys((STATE, *images), now)
            return Frame(np.array(self._environment.state), images, stamps)

    def get_state(self) -> Array:
        """``(state_dim,)`` of this moment, without drawing anything."""
        with self._lock:
            self._catch_up()
            return np.array(self._environment.state)

    def send_action(self, action: Array) -> None:
        """A new target ``(dim,)``; holds until the next one.

        Raises:
            Rejected: another shape, not finite, or beyond the embodiment's limits.
        """
        target = checked_action(self.embodiment, action)
        with self._lock:
            if self._began is None:
                self._began = self.clock.now()
            self._catch_up()
            self._target = target

    def task_success(self) -> bool:
        """Whether the task is done as of now."""
        with self._lock:
            return self._last_step is not None and bool(self._last_step.success)

    def task_done(self) -> bool:
        """Whether the episode ends here."""
        with self._lock:
            self._catch_up()
            return self._over()

    def stop(self) -> None:
        """Hold: the last command stays."""

    def close(self) -> None:
        """Nothing: the environment is closed where it was made."""

    def _over(self) -> bool:
        ended = self._last_step is not None and bool(self._last_step.ended)
        return ended or self.ticks >= self._limit

    def _catch_up(self) -> None:
        if self._began is None or self._target is None:
            return
        due = int((self.clock.now() - self._began) / self._period)
        self.late += max(0, min(due, self._limit) - self.ticks - 1)
        while self.ticks < due and not self._over():
            try:
                self._last_step = self._environment.step(self._target)
                check_step(self._environment, self.ticks + 1)
            except Exception as error:
                self.failed = error
                raise
            self.ticks += 1


class _TimedPolicy(Policy):
    """An actor as a ``Policy``; ``seconds`` is its total inference time."""

    embodiment: EmbodimentSpec
    cameras: tuple[str, ...]
    action_rate_hz: float
    horizon: int
    continues: bool
    n_obs_steps: int

    def __init__(self, actor: Actor, environment: Environment, cameras: tuple[Camera, ...]) -> None:
        spec, actor = environment.spec.embodiment, Actor.adapt(actor)
        self._actor = actor
        self.embodiment = actor.embodiment or replace(spec, cameras=cameras)
        self.cameras = tuple(camera.name for camera in cameras)
        self.action_rate_hz = float(
            spec.rate_hz if actor.action_rate_hz is None else actor.action_rate_hz
        )
        self.horizon = int(1 if actor.horizon is None else actor.horizon)
        self.continues = self._actor.continues
        self.n_obs_steps = actor.n_obs_steps
        self.seconds = 0.0

    def reset(self, seed: int) -> None:
        self._actor.reset(seed)

    def predict_action(self, observation: Observation) -> Array:
        return self._timed(self._actor.predict_action, observation)

    def continue_action(self, observation: Observation, rest: Continuation) -> Array:
        return self._timed(self._actor.continue_action, observation, rest)

    def _timed(self, predict: Callable[..., Array], *arguments: Any) -> Array:
        began = time.perf_counter()
        chunk = predict(*arguments)
        self.seconds += time.perf_counter() - began
        # An expert's chunks may be of any length; a policy has to keep to its horizon.
        own = self._actor.horizon
        self.horizon = len(chunk) if own is None else own
        return chunk


def run_live(
    name: str,
    environment: Environment,
    actor: Actor,
    task: TaskSpec,
    seed: int,
    policy_seed: int,
    cameras: tuple[Camera, ...],
    max_steps: int,
    live: LiveSettings,
) -> dict[str, Any]:
    """Run one episode on the wall clock.

    Args:
        name: of the folder of its recording.

    Returns:
        JSON values: ``success``, ``outcome``, ``problem`` (of a safety stop), ``steps`` (commands
        that were sent), ``ticks``, ``missed_ticks`` (those at which the policy had no target),
        ``skipped_ticks`` and ``late_ticks`` (of the machine), ``calls``, ``trips``,
        ``instruction``, ``record`` (the episode's folder) and ``timing``.

    Raises:
        ConfigError: the environment takes no joint targets, or an option does not fit.
        RunFailed: the environment's simulation diverged; or what its ``step`` raised.
    """
    from fluxvla_core.robot.runner import BaseInferenceRunner

    if not environment.spec.limited:
        raise ConfigError(
            f"{environment.spec.name} takes no joint targets, so a robot's limits cannot be "
            "applied to its actions; live evaluation always applies them",
            next="evaluate it stepped: --set <section>.live=false",
        )
    folder = Path(live.folder) / name
    shutil.rmtree(folder, ignore_errors=True)  # of an attempt that was cut short
    operator = EnvironmentOperator(environment, actor, task, seed, cameras, max_steps)
    policy = _TimedPolicy(actor, environment, cameras)
    joining = live.options.get("chunk_joining")
    if make_joiner(joining).continues and not policy.continues:
        raise ConfigError(
            f"live has chunk_joining {joining!r}, and the policy cannot continue a chunk: neither "
            "it nor its model takes what is left of the last one"
        )
    runner = BaseInferenceRunner(
        context=RunContext(work_dir=folder, task=task.name),
        seed=policy_seed,
        policy=policy,
        operator=operator,
        task_descriptions={task.name: task.instruction},
        # task_done() of the operator ends an episode; this ends one in which nothing moves.
        max_publish_step=2 * max_steps,
        record_fps=live.video_fps,
        **live.options,
    )
    runner.run_setup()
    with suppress(SafetyStop):  # what the safety stopped has failed; the summary says why
        runner.run()
    if operator.failed is not None:  # to the runner a robot that broke, which no policy can help
        raise operator.failed
    assert runner.recorder is not None
    summary = runner.recorder.summary
    answers = summary["timings"].get("policy", {})
    return {
        "success": bool(summary["success"]) and summary["outcome"] == "done",
        "outcome": summary["outcome"],
        "problem": summary["problem"],
        "steps": summary["steps"],
        "calls": summary["chunks"],
        "ticks": operator.ticks,
        "late_ticks": operator.late,
        "missed_ticks": summary["held_ticks"],
        "skipped_ticks": summary["skipped_ticks"],
        "trips": [trip["rule"] for trip in summary["trips"]],
        "instruction": task.instruction,
        "record": str(runner.recorder.folder.relative_to(live.folder)),
        "timing": {
            "seconds": operator.ticks / operator.embodiment.rate_hz,
            "policy_seconds": policy.seconds,
            "policy_p50_ms": answers.get("p50_ms"),
            "policy_p99_ms": answers.get("p99_ms"),
        },
    }
