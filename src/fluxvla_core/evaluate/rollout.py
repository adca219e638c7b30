"""One episode in an environment: observe, predict, execute some of the chunk, observe again.

Time stands still while the policy thinks. In an environment whose actions are joint targets the
commands are formed as on a robot: keyframes are joined linearly from the last command on and kept
within the same limits.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.environment import Actor, Environment, EnvironmentSpec, TaskSpec
from fluxvla_core.control.keyframes import interpolate
from fluxvla_core.errors import RunFailed, SpecMismatch
from fluxvla_core.safety.limits import Limiter
from fluxvla_core.safety.trips import action_columns, not_finite
from fluxvla_core.spec.embodiment import Camera

Array = npt.NDArray[np.float64]
Watch = Callable[[Environment, int], None]


@dataclass(frozen=True)
class Course:
    """How an episode is run, beside its environment, policy and key.

    Args:
        cameras: the pictures that the policy gets.
        replan_every: how many actions of a chunk are used before the next is asked for; all of
            them by default.
        max_steps: instead of the task's.
        policy_seed: the policy's seed is this more than the episode's.
    """

    cameras: tuple[Camera, ...] = ()
    replan_every: int | None = None
    max_steps: int | None = None
    policy_seed: int = 0


class Commands:
    """From a policy's actions to those that are executed; ``clamped`` of them were changed."""

    def __init__(self, spec: EnvironmentSpec, action_rate_hz: float | None) -> None:
        self.clamped = 0
        self._rate = spec.embodiment.rate_hz
        self._action_rate = action_rate_hz or self._rate
        self._lower = np.array([joint.lower for joint in spec.embodiment.joints])
        self._upper = np.array([joint.upper for joint in spec.embodiment.joints])
        self._columns = action_columns(spec.embodiment) if spec.limited else None
        self._limiter = Limiter(spec.embodiment, 1.0 / self._rate) if spec.limited else None

    def start(self, state: Array) -> None:
        """Begin an episode where the robot is."""
        self.clamped = 0
        if self._limiter is not None:
            self._limiter.start(state[self._columns])

    def of(self, chunk: Array) -> Array:
        """``(N, dim)`` targets, one for each control step; limited only when they are taken."""
        if self._limiter is None:
            return chunk
        return interpolate(self._limiter.last, chunk, self._action_rate, self._rate)

    def take(self, target: Array) -> Array:
        """The command for one target."""
        if self._limiter is None:
            # What such an environment does with a value beyond its limits is its own affair.
            slack = 1e-6 * (self._upper - self._lower)
            beyond = (target > self._upper + slack) | (target < self._lower - slack)
            self.clamped += bool(beyond.any())
            return target
        command, clamps = self._limiter.step(target)
        self.clamped += bool(clamps)
        return command


def run_episode(
    environment: Environment,
    actor: Actor,
    task: TaskSpec,
    seed: int,
    course: Course,
    told: TaskSpec | None = None,
    watch: Watch | None = None,
) -> dict[str, Any]:
    """Run one episode; its course follows from the arguments alone.

    A chunk that is not finite ends it: the policy has failed, as on a robot, where safety stops
    it. A state that is not finite is the environment's affair, and says nothing about the policy.

    Args:
        seed: of environment and, with ``course.policy_seed``, policy.
        told: the task whose instruction the policy is told instead; the environment is
            :class:`Retellable` then.
        watch: called with the number of steps before the first and after each, for a video.

    Returns:
        JSON values: ``success``, ``problem`` (what the policy did wrong, else None),
        ``behaviours`` (where the environment tells), ``steps``, ``calls`` (of the policy),
        ``clamped`` (actions beyond the limits), ``return`` (sum of rewards), ``state_hash``,
        ``instruction``, and ``timing`` in seconds: ``seconds``, ``policy_seconds``,
        ``step_seconds``, ``observe_seconds``.

    Raises:
        SpecMismatch: the policy's chunk is of another shape.
        RunFailed: the environment's state is not finite.
    """
    began = time.perf_counter()
    spent = dict.fromkeys(("policy", "step", "observe"), 0.0)
    environment.reset(seed, task.name)
    if told is not None:
        environment.tell(told.name)  # type: ignore[attr-defined]
    if hasattr(actor, "enter"):
        actor.enter(environment)
    actor.reset(course.policy_seed + seed)
    spec, limit = environment.spec, course.max_steps or task.max_steps
    commands = Commands(spec, getattr(actor, "action_rate_hz", None))
    start = environment.state
    check_state(start, 0)
    commands.start(start)
    own_hash = getattr(environment, "state_hash", None)
    digest = hashlib.sha256(start.tobytes())
    steps = calls = 0
    total, success, ended = 0.0, False, False
    behaviours: dict[str, bool] | None = None
    problem: str | None = None
    if watch is not None:
        watch(environment, 0)
    while not ended and steps < limit:
        at = time.perf_counter()
        observation = environment.observe(course.cameras)
        # Before the policy is asked: what it makes of such a state is not its fault.
        check_state(observation["qpos"], steps)
        seen = time.perf_counter()
        chunk = shaped(actor.predict_action(observation), spec.embodiment.dim)
        answered = time.perf_counter()
        del observation  # so that the next pictures can have its memory: fresh pages cost more
        spent["observe"] += seen - at
        spent["policy"] += answered - seen
        calls += 1
        problem = not_finite(chunk, spec.embodiment.joint_names)
        if problem is not None:
            success = False
            break
        for target in commands.of(chunk[: course.replan_every]):
            at = time.perf_counter()
            found = environment.step(commands.take(target))
            spent["step"] += time.perf_counter() - at
            steps += 1
            total += found.reward
            success, ended = bool(found.success), bool(found.ended)
            behaviours = None if found.behaviours is None else dict(found.behaviours)
            if own_hash is None:
                digest.update(environment.state.tobytes())
            if watch is not None:
                watch(environment, steps)
            if ended or steps >= limit:
                break
    return {
        "success": success,
        "problem": problem,
        **({} if behaviours is None else {"behaviours": behaviours}),
        "steps": steps,
        "calls": calls,
        "clamped": commands.clamped,
        "return": float(total),
        "state_hash": digest.hexdigest()[:16] if own_hash is None else own_hash(),
        "instruction": (told or task).instruction,
        "timing": {
            "seconds": time.perf_counter() - began,
            **{f"{name}_seconds": value for name, value in spent.items()},
        },
    }


def shaped(chunk: Any, dim: int) -> Array:
    """A chunk as ``(T, dim)`` float64, T at least 1.

    Raises:
        SpecMismatch: it is none; the policy is not for this environment, in any episode.
    """
    try:
        array = np.asarray(chunk, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise SpecMismatch(f"the policy's chunk is no array of numbers: {error}") from error
    if array.ndim != 2 or array.shape[1] != dim or not len(array):
        raise SpecMismatch(f"the policy's chunk has shape {array.shape}; (T, {dim}) is needed")
    return array


def check_state(state: Any, steps: int) -> None:
    """Refuse a state that is not finite after so many steps: its episode tells nothing."""
    if not np.isfinite(state).all():
        raise RunFailed(
            f"the environment's state is not finite after {steps} steps",
            cause="the simulation diverged",
        )


def find_task(tasks: Sequence[TaskSpec], name: str) -> TaskSpec:
    """The task called ``name``, which is one of ``tasks``."""
    return next(task for task in tasks if task.name == name)
