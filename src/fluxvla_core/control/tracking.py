"""Tracking error: ``TrackingWatch`` trips when the arm does not follow its commands."""

from __future__ import annotations

from collections import deque

import numpy as np
import numpy.typing as npt

from fluxvla_core.control.safety import BadFrame, NotFollowing, SafetySettings
from fluxvla_core.spec import VELOCITY, EmbodimentSpec

Array = npt.NDArray[np.float64]
# A prismatic joint's tracking error in m, as a share of a revolute one's in rad.
PRISMATIC_SHARE = 0.1
# A joint further than this from its last command (rad, or m) was blocked, or moved since: it is
# held where it is, and continues from there.
HOLD_REACH = {"revolute": 0.15, "prismatic": 0.015, "gripper": np.inf, VELOCITY: np.inf}
# Commands that are kept to hold a state against; an older one is too old to say anything.
_REMEMBERED = 256


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
            VELOCITY: np.inf,  # the ground, and what is pushed, decide how it follows
        }
        self._allowed: Array = np.array([allowed[j.kind] for j in embodiment.joints])
        reach = np.array([HOLD_REACH[j.kind] for j in embodiment.joints])
        self._reach: Array = np.minimum(self._allowed, reach)
        self._time = settings.tracking_time_s
        self._since: Array = np.full(len(self._names), np.inf)
        # ``(state_dim,)`` the last that was checked.
        self.seen: Array | None = None
        self._sent: deque[tuple[float, Array]] = deque(maxlen=_REMEMBERED)

    def reset(self) -> None:
        """Reset: the arm is where its command is."""
        self._since[:] = np.inf

    def sent(self, command: Array, at: float) -> None:
        """A ``(dim,)`` command was sent, at that time in seconds."""
        self._sent.append((at, command))

    def follows(self, command: Array, state: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Which joints, ``(dim,)``, are as near to ``command`` as they must be."""
        return self._error(command, state) <= self._allowed

    def settled(self, command: Array, state: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Which joints, ``(dim,)``, are where ``command`` left them in a stop, droop and all."""
        return self._error(command, state) <= self._reach

    def positions(self, state: npt.ArrayLike) -> Array:
        """``(dim,)`` where the action's joints are, of a ``(state_dim,)`` state."""
        return action_values(self._columns, state)

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
        self.seen = np.asarray(state, dtype=np.float64)
        # A copy, in one step: another thread stores commands meanwhile.
        sent = tuple(self._sent)
        command = next((c for at, c in reversed(sent) if at <= measured), None)
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
        return np.abs(self.positions(state) - command)


def action_columns(embodiment: EmbodimentSpec) -> npt.NDArray[np.intp]:
    """Indices ``(dim,)`` of the action joints in the state vector.

    A joint that is commanded by its speed need not be in the state; its index is -1 then.

    Raises:
        BadFrame: the state lacks another joint that is commanded.
    """
    names = embodiment.state_names
    missing = [j.name for j in embodiment.joints if j.name not in names and not j.by_speed]
    if missing:
        raise BadFrame(
            f"the state of {embodiment.name} does not contain {', '.join(missing)}; "
            "a joint that cannot be read back cannot be moved safely"
        )
    places = [names.index(n) if n in names else -1 for n in embodiment.joint_names]
    return np.array(places, dtype=np.intp)


def action_values(columns: npt.NDArray[np.intp], state: npt.ArrayLike) -> Array:
    """``(dim,)`` values of the action's joints in a ``(state_dim,)`` state; 0 of those without."""
    values = np.asarray(state, dtype=np.float64)[columns]
    return np.where(columns < 0, 0.0, values)
