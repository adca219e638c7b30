"""A policy's action chunks: checking them, and reading them off at any time.

A chunk holds targets at ``rate_hz`` (10 Hz is common), a robot takes commands at ``control_hz`` (50
Hz for ALOHA): between two keyframes the motion is linear. Keyframe ``j`` is to be reached
``(j + 1) / rate_hz`` seconds after the observation; before it, the arm is where ``previous`` says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fluxvla_core.robot.control.safety import BadChunk, SafetySettings
from fluxvla_core.spec.embodiment import EmbodimentSpec

Array = npt.NDArray[np.float64]
# How much further beyond its limits a gripper may be wanted: pressing is how policies hold things.
GRIPPER_EXCESS = 4.0


@dataclass(frozen=True)
class Chunk:
    """A policy's answer and what it was an answer to.

    Args:
        keyframes: ``(T, D)`` targets; those that shall be played.
        rate_hz: keyframes a second.
        observed: when the observation was made, on the loop's clock.
        anchor: ``(D,)`` the command that the arm had then.
    """

    keyframes: Array
    rate_hz: float
    observed: float
    anchor: Array

    @property
    def seconds(self) -> float:
        """How long it lasts."""
        return len(self.keyframes) / self.rate_hz

    def reaches(self, elapsed: float) -> bool:
        """Whether it lasts until ``elapsed`` seconds after its beginning."""
        # One part in a million of a keyframe's time is rounding, not an end.
        return elapsed <= self.seconds + 1e-6 / self.rate_hz

    def at(self, elapsed: float) -> Array:
        """``(D,)`` where it is after ``elapsed`` seconds; its first or last point outside it.

        The same as :func:`sample` for one moment. That works on the whole chunk, and numpy gives the
        interpreter up for arrays of that size: a thread that sends would have to get it again.
        """
        count = len(self.keyframes)
        position = min(max(elapsed * self.rate_hz, 0.0), float(count))
        before = min(int(position), max(count - 1, 0))
        share = position - before
        start = self.keyframes[before - 1] if before else self.anchor
        end = self.keyframes[before] if before < count else start
        point: Array = start * (1.0 - share) + end * share
        return point


def interpolate(
    previous: npt.ArrayLike, chunk: npt.ArrayLike, rate_hz: float, control_hz: float
) -> Array:
    """Commands at ``control_hz`` along straight lines from ``previous`` through all keyframes.

    Args:
        previous: ``(D,)`` where the arm is commanded to be at the observation.
        chunk: ``(T, D)`` targets, one every ``1 / rate_hz`` seconds.
        rate_hz: keyframes a second.
        control_hz: commands a second.

    Returns:
        ``(N, D)`` float64; command ``k`` is for ``(k + 1) / control_hz`` seconds after the
        observation, and ``N = floor(T * control_hz / rate_hz)``, at least 1 when ``T`` is.

    Raises:
        ValueError: shapes do not fit, or a rate is not positive.
    """
    keyframes = np.asarray(chunk, dtype=np.float64)
    if rate_hz <= 0 or control_hz <= 0:
        raise ValueError(f"rates must be positive, got {rate_hz} Hz and {control_hz} Hz")
    if keyframes.ndim != 2:
        raise ValueError(f"a chunk has shape (T, D), got {keyframes.shape}")
    # The small term keeps 3 keyframes at 10 Hz from becoming 14 commands at 50 Hz.
    count = int(np.floor(len(keyframes) * control_hz / rate_hz + 1e-6))
    count = max(count, min(len(keyframes), 1))
    return sample(previous, keyframes, rate_hz, (np.arange(count) + 1.0) / control_hz)


def sample(
    previous: npt.ArrayLike, chunk: npt.ArrayLike, rate_hz: float, elapsed: npt.ArrayLike
) -> Array:
    """Where the lines through ``previous`` and the keyframes are after ``elapsed`` seconds.

    Before 0 it is ``previous``, after the last keyframe the last keyframe.

    Args:
        previous: ``(D,)``.
        chunk: ``(T, D)``.
        rate_hz: keyframes a second.
        elapsed: ``(N,)`` seconds since the observation.

    Returns:
        ``(N, D)`` float64.

    Raises:
        ValueError: shapes do not fit.
    """
    start = np.asarray(previous, dtype=np.float64)
    keyframes = np.asarray(chunk, dtype=np.float64)
    if start.ndim != 1 or keyframes.ndim != 2 or keyframes.shape[1] != start.shape[0]:
        raise ValueError(
            f"previous of shape (D,) and chunk of shape (T, D) are needed, "
            f"got {start.shape} and {keyframes.shape}"
        )
    knots = np.concatenate([start[None], keyframes])
    position = np.clip(np.asarray(elapsed, dtype=np.float64) * rate_hz, 0.0, len(keyframes))
    before = np.minimum(position.astype(np.int64), max(len(keyframes) - 1, 0))
    share = (position - before)[:, None]
    after = np.minimum(before + 1, len(keyframes))
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
        chunk: ``(T, dim)`` keyframes from a policy.
        embodiment: describes the joints of the keyframes.
        rate_hz: keyframes a second.
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
        keyframes = found.astype(np.float64, copy=False)
    except (TypeError, ValueError) as error:
        raise BadChunk(f"the policy's chunk is no array of numbers: {error}") from error
    dim = embodiment.dim
    if keyframes.ndim != 2 or keyframes.shape[1] != dim or len(keyframes) == 0:
        raise BadChunk(
            f"the policy's chunk has shape {keyframes.shape}; {embodiment.name} takes (T, {dim})"
        )
    names = embodiment.joint_names
    problem = not_finite(keyframes, names)
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
    excess = np.maximum(lower - keyframes, keyframes - upper) / (upper - lower) / allowed
    row, column = np.unravel_index(np.argmax(excess), excess.shape)
    if excess[row, column] > 1.0:
        joint = joints[column]
        raise BadChunk(
            f"keyframe {row} wants {joint.name} at {keyframes[row, column]:.4g}, far beyond its "
            f"limits [{joint.lower:.4g}, {joint.upper:.4g}] {joint.unit}",
            cause="the policy's units or statistics are not this robot's",
        )
    _check_jumps(np.clip(keyframes, lower, upper), 1, embodiment, rate_hz, settings)
    return keyframes


def check_beginning(
    keyframes: Array,
    embodiment: EmbodimentSpec,
    last: Array,
    rate_hz: float,
    settings: SafetySettings,
) -> None:
    """Refuse a chunk whose first keyframe is too far from where the arm is commanded to be.

    Args:
        keyframes: ``(T, dim)`` that ``check_chunk`` let through.
        embodiment: describes the joints of the keyframes.
        last: ``(dim,)`` the command that the arm has now.
        rate_hz: keyframes a second.
        settings: ``jump_s``.

    Raises:
        BadChunk: no motion explains the jump.
    """
    lower, upper = np.array([(j.lower, j.upper) for j in embodiment.joints]).T
    points = np.array([last, np.clip(keyframes[0], lower, upper)])
    _check_jumps(points, 0, embodiment, rate_hz, settings)


def _check_jumps(
    points: Array, first: int, embodiment: EmbodimentSpec, rate_hz: float, settings: SafetySettings
) -> None:
    """Refuse jumps between points ``(N, dim)``; the second one is keyframe ``first``."""
    moves = np.diff(points, axis=0)
    # Each keyframe has its own period to move in; jump_s comes on top.
    seconds = np.abs(moves) / np.array([j.slew_rate for j in embodiment.joints]) - 1.0 / rate_hz
    if not (seconds > settings.jump_s).any():
        return
    row, column = np.unravel_index(np.argmax(seconds), seconds.shape)
    raise BadChunk(
        f"keyframe {row + first} wants {embodiment.joint_names[column]} to jump by "
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
    return f"the policy's chunk is not finite: keyframe {row}, {joints[column]} is {value}"
