"""One stepped episode: observe, predict, execute some of the chunk, observe again.

Time stands still while the policy computes. In an environment whose actions are joint targets the
commands are formed by the same path as on a robot: a chunk's actions are joined linearly from the
last command on and kept within the same limits. Other actions pass the limits unchanged.

A policy that acts on several observations also gets those of the action steps before: of every
action that is executed, as far back as it looks.
"""

from __future__ import annotations

import hashlib
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.contract import implements
from fluxvla_core.contracts.environment import Environment, EnvironmentSpec, TaskSpec
from fluxvla_core.contracts.frame import Observation
from fluxvla_core.contracts.policy import Actor, with_history
from fluxvla_core.control.chunks import interpolate, not_finite
from fluxvla_core.control.limits import CommandLimiter
from fluxvla_core.control.sender import CommandPipeline, PassThrough
from fluxvla_core.control.tracking import action_columns, action_values
from fluxvla_core.errors import ConfigError, RunFailed, SpecMismatch
from fluxvla_core.spec import Camera

Array = npt.NDArray[np.float64]
OnStep = Callable[[Environment, int], None]


@dataclass(frozen=True)
class RolloutSettings:
    """Settings of an episode, besides its environment, policy, task and seed.

    Args:
        cameras: the images that the policy gets.
        replan_every: how many actions of a chunk are executed before the policy is queried again;
            all of them by default.
        max_steps: instead of the task's.
        policy_seed: the policy's seed is this more than the episode's.
    """

    cameras: tuple[Camera, ...] = ()
    replan_every: int | None = None
    max_steps: int | None = None
    policy_seed: int = 0


def run_episode(
    environment: Environment,
    actor: Actor,
    task: TaskSpec,
    seed: int,
    settings: RolloutSettings,
    instruction_of: TaskSpec | None = None,
    on_step: OnStep | None = None,
) -> dict[str, Any]:
    """Run one episode; everything in it follows from the arguments alone.

    A chunk that is not finite ends it: the policy has failed, as on a robot, where safety stops
    it. A simulation that diverges is an error of the environment, and says nothing about the
    policy.

    Args:
        seed: seed of the environment and, with ``settings.policy_seed``, policy.
        instruction_of: the task whose instruction the policy gets instead of that of ``task``, one
            of the environment's ``other_tasks``.
        on_step: called with the environment and the number of steps, before the first step and
            after each, for a video.

    Returns:
        JSON values: ``success``, ``problem`` (what the policy did wrong, else None),
        ``behaviours`` (if the environment reports them), ``steps``, ``calls`` (of the policy),
        ``clamped`` (actions beyond the limits), ``return`` (sum of rewards), ``state_hash``,
        ``instruction``, and ``timing`` in seconds: ``seconds``, ``policy_seconds``,
        ``step_seconds``, ``observe_seconds``.

    Raises:
        SpecMismatch: the policy's chunk is of another shape.
        Diverged: the environment's state is not finite, or its simulation diverged.
    """
    began = time.perf_counter()
    spent = dict.fromkeys(("policy", "step", "observe"), 0.0)
    environment, actor = Environment.adapt(environment), Actor.adapt(actor)
    environment.reset(seed, task.name)
    if instruction_of is not None:
        environment.set_instruction(instruction_of.name)
    actor.enter(environment)
    actor.reset(settings.policy_seed + seed)
    spec, limit = environment.spec, settings.max_steps or task.max_steps
    commands = ChunkCommands(spec, actor.action_rate_hz)
    start = check_step(environment, 0)
    commands.start(start)
    own_hash = implements(environment, Environment, "state_hash")
    state_digest = hashlib.sha256(start.tobytes())
    steps = calls = 0
    total, success, ended = 0.0, False, False
    behaviours: dict[str, bool] | None = None
    problem: str | None = None
    # The environment may have another instruction for each episode.
    instruction = (instruction_of or task).instruction
    stride = history_stride(actor, spec.embodiment.rate_hz)
    before: deque[Observation] = deque(maxlen=max(actor.n_obs_steps - 1, 0))
    if on_step is not None:
        on_step(environment, 0)
    while not ended and steps < limit:
        at = time.perf_counter()
        observation = environment.observe(settings.cameras)
        instruction = observation["task_description"]
        # Before the policy is queried: what it makes of such a state is not its fault.
        check_state(observation["qpos"], steps)
        observed_at = time.perf_counter()
        asked = with_history(observation, actor.n_obs_steps, tuple(before))
        chunk = shaped(actor.predict_action(asked), spec.embodiment.dim)
        answered = time.perf_counter()
        before.append(observation)
        del observation, asked  # so that the next images can have its memory: fresh pages cost more
        spent["observe"] += observed_at - at
        spent["policy"] += answered - observed_at
        calls += 1
        problem = not_finite(chunk, spec.embodiment.joint_names)
        if problem is not None:
            success = False
            break
        targets = commands.targets(chunk[: settings.replan_every])
        for left, target in zip(reversed(range(len(targets))), targets, strict=True):
            at = time.perf_counter()
            outcome = environment.step(commands.command(target))
            spent["step"] += time.perf_counter() - at
            steps += 1
            total += outcome.reward
            # Before anything is made of it: a scene that resets itself may even look like success.
            state = check_step(environment, steps)
            success, ended = bool(outcome.success), bool(outcome.ended)
            behaviours = None if outcome.behaviours is None else dict(outcome.behaviours)
            if not own_hash:
                state_digest.update(state.tobytes())
            if on_step is not None:
                on_step(environment, steps)
            if ended or steps >= limit:
                break
            if left and left % stride == 0 and left // stride < actor.n_obs_steps:
                at = time.perf_counter()
                before.append(environment.observe(settings.cameras))
                spent["observe"] += time.perf_counter() - at
    return {
        "success": success,
        "problem": problem,
        **({} if behaviours is None else {"behaviours": behaviours}),
        "steps": steps,
        "calls": calls,
        "clamped": commands.clamped,
        "return": float(total),
        "state_hash": environment.state_hash() if own_hash else state_digest.hexdigest()[:16],
        "instruction": instruction,
        "timing": {
            "seconds": time.perf_counter() - began,
            **{f"{name}_seconds": value for name, value in spent.items()},
        },
    }


class ChunkCommands:
    """Turns a policy's chunks into commands of an environment, as for a robot.

    ``clamped`` counts the commands that were changed by a limit, or that are beyond the limits of
    an environment that takes no joint targets.

    Args:
        spec: the environment's description.
        action_rate_hz: actions a second; the environment's rate by default.
    """

    def __init__(self, spec: EnvironmentSpec, action_rate_hz: float | None) -> None:
        self.clamped = 0
        body = spec.embodiment
        self._rate = body.rate_hz
        self._action_rate = action_rate_hz or self._rate
        self._columns = action_columns(body) if spec.limited else np.arange(0)
        self._limiter = CommandLimiter(body, 1.0 / self._rate) if spec.limited else None
        self._pipeline = CommandPipeline(self._limiter or PassThrough(body))

    def start(self, state: Array) -> None:
        """Begin an episode where the robot is."""
        self.clamped = 0
        if self._limiter is not None:
            self._limiter.start(action_values(self._columns, state))

    def targets(self, chunk: Array) -> Array:
        """``(N, dim)``, one for each control step; limited only when they are taken."""
        if self._limiter is None:
            return chunk
        return interpolate(self._limiter.last, chunk, self._action_rate, self._rate)

    def command(self, target: Array) -> Array:
        """The ``(dim,)`` command for one target."""
        commands, clamps = self._pipeline.form(target[None])
        self.clamped += bool(clamps[0])
        return np.asarray(commands[0])


def history_stride(actor: Actor, rate_hz: float) -> int:
    """Control steps between two observations of a policy's history: those of one of its actions.

    Raises:
        ConfigError: the policy needs a history, and its actions are no whole number of steps.
    """
    own = actor.action_rate_hz
    if actor.n_obs_steps == 1 or own is None:
        return 1
    stride = round(rate_hz / own)
    if stride < 1 or abs(stride * own - rate_hz) > 1e-9 * rate_hz:
        raise ConfigError(
            f"the policy acts on {actor.n_obs_steps} observations (n_obs_steps) 1/{own:g} s apart, "
            f"the environment takes steps of 1/{rate_hz:g} s: it cannot be observed in between",
            next="train on data whose frame rate divides the environment's rate",
        )
    return stride


def shaped(chunk: Any, dim: int) -> Array:
    """A chunk as ``(T, dim)`` float64, T at least 1.

    Raises:
        SpecMismatch: it is none; the policy is not for this environment, in any episode.
    """
    try:
        array = np.asarray(chunk, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise SpecMismatch(f"the policy's chunk is not an array of numbers: {error}") from error
    if array.ndim != 2 or array.shape[1] != dim or not len(array):
        raise SpecMismatch(f"the policy's chunk has shape {array.shape}; (T, {dim}) is needed")
    return array


class Diverged(RunFailed):
    """A simulation diverged, so the episode's outcome says nothing about the policy."""


def check_step(environment: Environment, steps: int) -> Array:
    """The environment's state after so many steps.

    Raises:
        Diverged: it is not finite, or the environment's ``divergence()`` says what went wrong.
    """
    state = environment.state
    check_state(state, steps)
    why = environment.divergence()
    if why is not None:
        raise Diverged(
            f"the simulation diverged in the first {steps} steps: {why}",
            cause="what happened was too fast for the simulator's time step, as two bodies that "
            "are pressed into each other; the episode says nothing about the policy",
        )
    return state


def check_state(state: Any, steps: int) -> None:
    """Refuse a state that is not finite after so many steps.

    Raises:
        Diverged: the message says after how many.
    """
    if not np.isfinite(state).all():
        raise Diverged(
            f"the environment's state is not finite after {steps} steps",
            cause="the simulation diverged",
        )
