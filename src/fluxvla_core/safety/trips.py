"""Rules that end a motion, and the latch that keeps it ended until somebody says otherwise."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import FluxError, SafetyStop
from fluxvla_core.safety.settings import SafetySettings
from fluxvla_core.safety.stops import BadChunk, BadFrame, NotFollowing
from fluxvla_core.spec.embodiment import EmbodimentSpec

Array = npt.NDArray[np.float64]
# A prismatic joint's tracking error in m, as a share of a revolute one's in rad.
PRISMATIC_SHARE = 0.1
# How much further beyond its limits a gripper may be wanted: pressing is how policies hold things.
GRIPPER_EXCESS = 4.0
# A joint further than this from its last command (rad, or m) was blocked, or moved since: it is
# held where it is, and goes on from there.
HOLD_REACH = {"revolute": 0.15, "prismatic": 0.015, "gripper": np.inf}
# Commands that are kept to hold a state against; an older one is too old to say anything.
_REMEMBERED = 256


@dataclass(frozen=True)
class Trip:
    """Why a motion ended: which rule, what it saw, and when (seconds on the loop's clock)."""

    rule: str
    what: str
    at: float


class Latch:
    """Once tripped, nothing moves until ``rearm`` is called; every trip is kept.

    Args:
        now: the loop's clock.
    """

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._open: Trip | None = None
        self.trips: list[Trip] = []

    @property
    def tripped(self) -> Trip | None:
        """The trip that holds the robot, or None."""
        return self._open

    def trip(self, rule: str, error: FluxError | str) -> Trip:
        """Record a trip and hold the robot."""
        what = error.what if isinstance(error, FluxError) else error
        found = Trip(rule, what, self._now())
        self.trips.append(found)
        self._open = self._open or found
        return found

    def check(self) -> None:
        """Refuse to move on while tripped.

        Raises:
            SafetyStop: names the first trip since the last re-arming.
        """
        if self._open is not None:
            raise SafetyStop(
                f"stopped by rule {self._open.rule}: {self._open.what}",
                next="look at the robot, remove the cause, then re-arm",
            )

    def rearm(self) -> None:
        """Allow motion again; what was recorded stays."""
        self._open = None


class TrackingWatch:
    """Trips when the arm stays too far behind its commands: it is blocked, or not following.

    Args:
        embodiment: whose action joints are compared with the state's joints of the same names.
        settings: ``tracking_error`` and ``tracking_time_s``.
    """

    def __init__(self, embodiment: EmbodimentSpec, settings: SafetySettings) -> None:
        self._names = embodiment.joint_names
        self._columns = action_columns(embodiment)
        allowed = {
            "revolute": settings.tracking_error,
            "prismatic": settings.tracking_error * PRISMATIC_SHARE,
            "gripper": np.inf,
        }
        self._allowed: Array = np.array([allowed[j.kind] for j in embodiment.joints])
        reach = np.array([HOLD_REACH[j.kind] for j in embodiment.joints])
        self._reach: Array = np.minimum(self._allowed, reach)
        self._time = settings.tracking_time_s
        self._since: Array = np.full(len(self._names), np.inf)
        self._sent: deque[tuple[float, Array]] = deque(maxlen=_REMEMBERED)

    def reset(self) -> None:
        """Begin anew: the arm is where its command is."""
        self._since[:] = np.inf

    def sent(self, command: Array, at: float) -> None:
        """A ``(dim,)`` command was sent, at that time in seconds."""
        self._sent.append((at, command))

    def follows(self, command: Array, state: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Which joints, ``(dim,)``, are as near to ``command`` as they must be."""
        return self._error(command, state) <= self._allowed

    def stayed(self, command: Array, state: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Which joints, ``(dim,)``, are where ``command`` left them in a stop, droop and all."""
        return self._error(command, state) <= self._reach

    def check(self, state: npt.ArrayLike, measured: float) -> None:
        """Compare where the arm was with the command that it had then.

        An old state says nothing about the arm now: it is held against what was sent before it was
        measured, and it is not behind for longer than it was measured to be.

        Args:
            state: ``(state_dim,)`` as measured.
            measured: when that was, in seconds.

        Raises:
            NotFollowing: a joint has been too far behind for too long.
        """
        command = next((c for at, c in reversed(tuple(self._sent)) if at <= measured), None)
        if command is None:
            return
        error = self._error(command, state)
        behind = error > self._allowed
        self._since = np.where(behind, np.minimum(self._since, measured), np.inf)
        late = np.flatnonzero(behind & (measured - self._since >= self._time))
        if late.size:
            index = int(late[np.argmax(error[late])])
            seconds = measured - self._since[index]
            raise NotFollowing(
                f"{self._names[index]} is {error[index]:.3g} away from its command "
                f"for {seconds:.2f} s; {self._allowed[index]:.3g} are allowed for {self._time:g} s",
                cause="the arm is blocked, its drive is off, or somebody else commands it",
                next="free the arm; safety.tracking_error sets what is allowed",
            )

    def _error(self, command: Array, state: npt.ArrayLike) -> Array:
        return np.abs(np.asarray(state, dtype=np.float64)[self._columns] - command)


def action_columns(embodiment: EmbodimentSpec) -> npt.NDArray[np.intp]:
    """Where in the state vector each action joint's position is; ``(dim,)`` indices.

    Raises:
        BadFrame: the state lacks a joint that is commanded.
    """
    names = embodiment.state_names
    missing = [name for name in embodiment.joint_names if name not in names]
    if missing:
        raise BadFrame(
            f"the state of {embodiment.name} does not tell where {', '.join(missing)} is; "
            "a joint that cannot be read back cannot be moved safely"
        )
    return np.array([names.index(name) for name in embodiment.joint_names], dtype=np.intp)


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
        embodiment: whose joints they are for.
        rate_hz: keyframes a second.
        settings: ``jump_s`` and ``excess``.

    Returns:
        ``(T, dim)`` float64.

    Raises:
        BadChunk: another shape, empty, a value that is not finite, far beyond a position limit,
            or a jump that no motion explains.
    """
    try:
        keyframes = np.asarray(chunk, dtype=np.float64)
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
        embodiment: whose joints they are for.
        last: ``(dim,)`` the command that the arm has now.
        rate_hz: keyframes a second.
        settings: ``jump_s``.

    Raises:
        BadChunk: no motion explains the jump.
    """
    lower, upper = np.array([(j.lower, j.upper) for j in embodiment.joints]).T
    way = np.array([last, np.clip(keyframes[0], lower, upper)])
    _check_jumps(way, 0, embodiment, rate_hz, settings)


def _check_jumps(
    way: Array, first: int, embodiment: EmbodimentSpec, rate_hz: float, settings: SafetySettings
) -> None:
    """Of the points ``(N, dim)`` of a way, the second of which is keyframe ``first``."""
    moves = np.diff(way, axis=0)
    # Each keyframe has its own period to move in; jump_s comes on top.
    seconds = np.abs(moves) / np.array([j.velocity for j in embodiment.joints]) - 1.0 / rate_hz
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
    """What of a policy's chunk ``(T, dim)`` is not finite, in words; None if all of it is."""
    bad = np.argwhere(~np.isfinite(chunk))
    if not bad.size:
        return None
    row, column = bad[0]
    value = chunk[row, column]
    return f"the policy's chunk is not finite: keyframe {row}, {joints[column]} is {value}"
