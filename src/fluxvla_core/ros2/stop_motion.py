"""Stop motions: the commands that brake an arm, and the checks of what is sent.

A stop goes from the last command to the one that holds the arm, within its limits.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.control.limits import CommandLimiter
from fluxvla_core.control.tracking import HOLD_REACH
from fluxvla_core.errors import Rejected
from fluxvla_core.spec import EmbodimentSpec

Array = npt.NDArray[np.float64]
log = logging.getLogger("fluxvla.ros2")
# A ``(state_dim,)`` state, and when it arrived.
TimedState = tuple[Array, float]
PATIENCE_S = 0.25
"""How long a joint that lags may keep moving towards its last command."""
# Commands further apart than this are single ones, and no motion that could be braked.
_APART_S = 0.25
# No arm takes as long to come to rest.
_LONGEST_S = 3.0
# How long a last command may take to be acknowledged before the connection is given up.
_RECEIPT_S = 0.2


def checked_action(embodiment: EmbodimentSpec, action: npt.ArrayLike) -> Array:
    """A fresh ``(dim,)`` float64 copy of ``action``.

    Raises:
        Rejected: another shape, not finite, or outside the joints' position limits.
    """
    values = np.array(action, dtype=np.float64)
    if values.shape != (embodiment.dim,):
        raise Rejected(
            f"{embodiment.name} takes actions of shape ({embodiment.dim},), got {values.shape}"
        )
    for joint, value in zip(embodiment.joints, values.tolist(), strict=True):
        if not math.isfinite(value):
            raise Rejected(f"{joint.name}: the command is {value}, not a finite number")
        if not joint.lower <= value <= joint.upper:
            raise Rejected(
                f"{joint.name}: the command {value:.4g} {joint.unit} is outside "
                f"[{joint.lower:.4g}, {joint.upper:.4g}]"
            )
    return values


class Motion:
    """The last commands of an arm and their times: the motion that a stop has to brake."""

    def __init__(self) -> None:
        self._last: Array | None = None
        self._at = 0.0
        # The command before the last, and the seconds between the two.
        self._before: tuple[Array, float] | None = None

    def sent(self, command: Array) -> None:
        """A ``(dim,)`` command was sent now."""
        now = time.monotonic()
        last, apart = self._last, now - self._at
        self._before = (last, apart) if last is not None and apart < _APART_S else None
        self._last, self._at = command, now

    def stop_commands(
        self,
        embodiment: EmbodimentSpec,
        last: Array,
        measured: tuple[TimedState, TimedState] | None,
    ) -> list[Array]:
        """The commands of a stop, one at least; the motion before it is forgotten.

        Args:
            embodiment: whose limits, and whose rate.
            last: ``(dim,)`` the last command.
            measured: the arm's newest state and the one before it; None if unknown.
        """
        period = 1.0 / embodiment.rate_hz
        before, apart = self._before or (last, period)
        # Commands come at a fixed rate, however late a single one is.
        seconds = max(round(apart / period), 1) * period
        moving = time.monotonic() - self._at <= 2.5 * seconds
        self._last = self._before = None
        target = last
        if measured is not None:
            (state, receipt), (earlier, then) = measured
            ahead = time.monotonic() - receipt + PATIENCE_S
            moved = (state - earlier) * (ahead / (receipt - then) if receipt > then else 0.0)
            target = hold_target(embodiment, last, state, moved)
        return list(braking_commands(embodiment, last, before if moving else last, seconds, target))

    def wait(self, embodiment: EmbodimentSpec) -> None:
        """Wait until the next command of a stop is due: not sooner after the last than usual."""
        now = time.monotonic()
        due = max(self._at + 1.0 / embodiment.rate_hz, now)
        time.sleep(due - now)
        self._at = due


def hold_target(embodiment: EmbodimentSpec, last: Array, state: Array, moved: Array) -> Array:
    """The command that holds an arm: the last one, but for joints that are kept from following.

    Such a joint (``HOLD_REACH``) is held where it is: pushing on would be no stop. Grippers have no
    such reach and keep their command: what they hold is why they are behind it. Nor is a joint sent
    back that is on its way to its last command; one that did not move is not taken to do so.

    Args:
        last: ``(dim,)`` last command.
        state: ``(state_dim,)`` as measured.
        moved: ``(state_dim,)`` how far each joint gets until it is looked at again, if it keeps
            moving as it did; signed.
    """
    where = {name: index for index, name in enumerate(embodiment.state_names)}
    target = last.copy()
    for index, joint in enumerate(embodiment.joints):
        column = where.get(joint.name)
        if column is None or joint.by_speed:
            continue
        way = last[index] - state[column]
        nearer = max(moved[column] * np.sign(way), 0.0)
        if abs(way) > HOLD_REACH[joint.kind] + nearer:
            target[index] = min(max(state[column], joint.lower), joint.upper)
    return target


def braking_commands(
    embodiment: EmbodimentSpec, last: Array, before: Array, seconds: float, target: Array
) -> Array:
    """Commands from the last one to rest, within the limits of the embodiment.

    Joints whose target is the last command brake; those that are commanded by their speed come to
    0. One that is to be held elsewhere does not obey: its command halts at once, and goes from
    there to its target.

    Args:
        embodiment: whose limits, and whose rate.
        last: ``(dim,)`` the last command.
        before: ``(dim,)`` the one before it.
        seconds: between these two.
        target: ``(dim,)`` of ``hold_target``.

    Returns:
        ``(N, dim)``, one at least: to repeat the last command is to hold.
    """
    if embodiment.action_mode != "absolute":
        return np.where([joint.by_speed for joint in embodiment.joints], 0.0, target)[None]
    limiter = CommandLimiter(embodiment, 1.0 / embodiment.rate_hz)
    limiter.resume(last, before, seconds)
    blocked = target != last
    limiter.halt(blocked)
    goal = np.where(blocked, target, limiter.rest())
    rows = []
    for _ in range(int(_LONGEST_S * embodiment.rate_hz)):
        if limiter.at_rest and (limiter.last == goal).all():
            break
        rows.append(limiter.settle(goal))
    return np.array(rows or [last])


def attempt(who: str, step: Callable[[], object]) -> bool:
    """Take a step of a robot's stop; whether it succeeded. What fails is logged, never raised."""
    try:
        step()
    except Exception as error:  # noqa: BLE001 - the caller ends a motion for another reason
        log.error("%s: stopping failed: %s", who, error)
        return False
    return True


def wait_for_receipt(publishers: Mapping[str, Any]) -> None:
    """Wait until the last messages were acknowledged; what fails is logged, never raised.

    Args:
        publishers: topic -> publisher.
    """
    from rclpy.duration import Duration

    for topic, publisher in publishers.items():
        try:
            publisher.wait_for_all_acked(Duration(seconds=_RECEIPT_S))
        except Exception as error:  # noqa: BLE001 - a broken publisher has nothing to wait for
            log.error("the last message on %s may not have arrived: %s", topic, error)
