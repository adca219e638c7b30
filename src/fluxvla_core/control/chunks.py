"""A policy's action chunks: checking them, and interpolating them at any time.

A chunk's actions are targets at ``rate_hz`` (10 Hz is common), a robot takes commands at
``control_hz`` (50 Hz for ALOHA): between two actions the motion is linear. Action ``j`` is to be
reached ``(j + 1) / rate_hz`` seconds after the observation; before it, the arm is where
``previous`` says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fluxvla_core.control.safety import BadChunk, SafetySettings
from fluxvla_core.spec import EmbodimentSpec

Array = npt.NDArray[np.float64]
# How much further beyond its limits a gripper may be wanted: pressing is how policies hold things.
GRIPPER_EXCESS = 4.0


@dataclass(frozen=True)
class Chunk:
    """A policy's answer and what it was an answer to.

    Args:
        actions: ``(T, D)`` targets; those that shall be played.
        rate_hz: actions a second.
        observed: when the observation was made, on the loop's clock.
        anchor: ``(D,)`` the command that the arm had then.
    """

    actions: Array
    rate_hz: float
    observed: float
    anchor: Array

    @property
    def seconds(self) -> float:
        """How long it lasts."""
        return len(self.actions) / self.rate_hz

    def reaches(self, elapsed: float) -> bool:
        """Whether it lasts until ``elapsed`` seconds after its beginning."""
        # One part in a million of an action's time is rounding, not an end.
        return elapsed <= self.seconds + 1e-6 / self.rate_hz

    def at(self, elapsed: float) -> Array:
        """``(D,)`` where it is after ``elapsed`` seconds; its first or last point outside it.

        The same as :func:`sample` for one moment. That works on the whole chunk, and numpy releases
        the GIL for arrays of that size: a thread that sends would have to get it again.
        """
        count = len(self.actions)
        position = min(max(elapsed * self.rate_hz, 0.0), float(count))
        before = min(int(position), max(count - 1, 0))
        share = position - before
        start = self.actions[before - 1] if before else self.anchor
        end = self.actions[before] if before < count else start
        point: Array = start * (1.0 - share) + end * share
        return point


def interpolate(
    previous: npt.ArrayLike, chunk: npt.ArrayLike, rate_hz: float, control_hz: float
) -> Array:
    """Commands at ``control_hz`` along straight lines from ``previous`` through all actions.

    Args:
        previous: ``(D,)`` where the arm is commanded to be at the observation.
        chunk: ``(T, D)`` targets, one every ``1 / rate_hz`` seconds.
        rate_hz: actions a second.
        control_hz: commands a second.

    Returns:
        ``(N, D)`` float64; command ``k`` is for ``(k + 1) / control_hz`` seconds after the
        observation, and ``N = floor(T * control_hz / rate_hz)``, at least 1 when ``T`` is.

    Raises:
        ValueError: shapes do not fit, or a rate is not positive.
    """
    actions = np.asarray(chunk, dtype=np.float64)
    if rate_hz <= 0 or control_hz <= 0:
        raise ValueError(f"rates must be positive, got {rate_hz} Hz and {control_hz} Hz")
    if actions.ndim != 2:
        raise ValueError(f"a chunk has shape (T, D), got {actions.shape}")
    # The small term keeps 3 actions at 10 Hz from becoming 14 commands at 50 Hz.
    count = int(np.floor(len(actions) * control_hz / rate_hz + 1e-6))
    count = max(count, min(len(actions), 1))
    return sample(previous, actions, rate_hz, (np.arange(count) + 1.0) / control_hz)


def sample(
    previous: npt.ArrayLike, chunk: npt.ArrayLike, rate_hz: float, elapsed: npt.ArrayLike
) -> Array:
    """Where the lines through ``previous`` and the actions are after ``elapsed`` seconds.

    Before 0 it is ``previous``, after the last action the last action.

    Args:
        previous: ``(D,)``.
        chunk: ``(T, D)``.
        rate_hz: actions a second.
        elapsed: ``(N,)`` seconds since the observation.

    Returns:
        ``(N, D)`` float64.

    Raises:
        ValueError: shapes do not fit.
    """
    start = np.asarray(previous, dtype=np.float64)
    actions = np.asarray(chunk, dtype=np.float64)
    if start.ndim != 1 or actions.ndim != 2 or actions.shape[1] != start.shape[0]:
        raise ValueError(
            f"previous of shape (D,) and chunk of shape (T, D) are needed, "
            f"got {start.shape} and {actions.shape}"
        )
    knots = np.concatenate([start[None], actions])
    position = np.clip(np.asarray(elapsed, dtype=np.float64) * rate_hz, 0.0, len(actions))
    before = np.minimum(position.astype(np.int64), max(len(actions) - 1, 0))
    share = (position - before)[:, None]
    after = np.minimum(before + 1, len(actions))
    points: Array = knots[before] * (1.0 - share) + knots[after] * share
    return points


def check_chunk(
    chunk: npt.ArrayLike,
    embodiment: EmbodimentSpec,
    rate_hz: float,
    settings: SafetySettings,
) -> Array:
    """Refuse a chunk that is no motion; what is merely too fast or too far is left to the limits.

    Whether the arm gets to its beginning is for ``check_beginning``.

    Args:
        chunk: ``(T, dim)`` actions from a policy.
        embodiment: describes the joints of the actions.
        rate_hz: actions a second.
        settings: ``jump_s`` and ``excess``.

    Returns:
        ``(T, dim)`` float64.

    Raises:
        BadChunk: another shape, empty, a value that is not finite, far beyond a position limit,
            or a jump that no motion explains.
    """
    try:
        found = np.asarray(chunk)
        if found.dtype.kind not in "fiu":
            raise TypeError(f"it is a {type(chunk).__name__} of {found.dtype}")
        actions = found.astype(np.float64, copy=False)
    except (TypeError, ValueError) as error:
        raise BadChunk(f"the policy's chunk is no array of numbers: {error}") from error
    dim = embodiment.dim
    if actions.ndim != 2 or actions.shape[1] != dim or len(actions) == 0:
        raise BadChunk(
            f"the policy's chunk has shape {actions.shape}; {embodiment.name} takes (T, {dim})"
        )
    names = embodiment.joint_names
    problem = not_finite(actions, names)
    if problem is not None:
        raise BadChunk(
            problem,
            cause="the policy diverged, or an input that it was given is not finite",
        )
    joints = embodiment.joints
    lower, upper = np.array([(j.lower, j.upper) for j in joints]).T
    allowed = np.array(
        [settings.excess * (GRIPPER_EXCESS if j.kind == "gripper" else 1.0) for j in joints]
    )
    excess = np.maximum(lower - actions, actions - upper) / (upper - lower) / allowed
    row, column = np.unravel_index(np.argmax(excess), excess.shape)
    if excess[row, column] > 1.0:
        joint = joints[column]
        raise BadChunk(
            f"action {row} wants {joint.name} at {actions[row, column]:.4g}, far beyond its "
            f"limits [{joint.lower:.4g}, {joint.upper:.4g}] {joint.unit}",
            cause="the policy's units or statistics are not this robot's",
        )
    _check_jumps(np.clip(actions, lower, upper), 1, embodiment, rate_hz, settings)
    return actions


def check_beginning(
    actions: Array,
    embodiment: EmbodimentSpec,
    last: Array,
    rate_hz: float,
    settings: SafetySettings,
) -> None:
    """Refuse a chunk whose first action is too far from where the arm is commanded to be.

    Args:
        actions: ``(T, dim)`` that ``check_chunk`` let through.
        embodiment: describes the joints of the actions.
        last: ``(dim,)`` the command that the arm has now.
        rate_hz: actions a second.
        settings: ``jump_s``.

    Raises:
        BadChunk: no motion explains the jump.
    """
    lower, upper = np.array([(j.lower, j.upper) for j in embodiment.joints]).T
    points = np.array([last, np.clip(actions[0], lower, upper)])
    _check_jumps(points, 0, embodiment, rate_hz, settings)


def _check_jumps(
    points: Array, first: int, embodiment: EmbodimentSpec, rate_hz: float, settings: SafetySettings
) -> None:
    """Refuse jumps between points ``(N, dim)``; the second one is action ``first``."""
    moves = np.diff(points, axis=0)
    # Each action has its own period to move in; jump_s comes on top.
    seconds = np.abs(moves) / np.array([j.slew_rate for j in embodiment.joints]) - 1.0 / rate_hz
    if not (seconds > settings.jump_s).any():
        return
    row, column = np.unravel_index(np.argmax(seconds), seconds.shape)
    raise BadChunk(
        f"action {row + first} wants {embodiment.joint_names[column]} to jump by "
        f"{moves[row, column]:.4g}; at full speed that takes {seconds[row, column]:.2f} s more "
        "than there are",
        cause="the policy is not for the pose that the arm is in, or it diverged",
        next="move the arm to the start pose first; safety.jump_s sets what is allowed",
    )


def not_finite(chunk: Array, joints: Sequence[str]) -> str | None:
    """A message that names the first value of a chunk ``(T, dim)`` that is not finite, or None."""
    bad = np.argwhere(~np.isfinite(chunk))
    if not bad.size:
        return None
    row, column = bad[0]
    value = chunk[row, column]
    return f"the policy's chunk is not finite: action {row}, {joints[column]} is {value}"
