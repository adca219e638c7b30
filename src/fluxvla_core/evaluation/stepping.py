"""Stepping an environment: commands from a policy's chunks, checks of chunk and state."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.environment import Environment, EnvironmentSpec
from fluxvla_core.contracts.policy import Actor
from fluxvla_core.control.chunks import interpolate
from fluxvla_core.control.limits import CommandLimiter
from fluxvla_core.control.sender import CommandPipeline, PassThrough
from fluxvla_core.control.tracking import action_columns, action_values
from fluxvla_core.errors import ConfigError, RunFailed, SpecMismatch

Array = npt.NDArray[np.float64]


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
