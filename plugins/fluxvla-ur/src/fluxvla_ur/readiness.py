"""Checks of a UR: whether it may be commanded, and whether it still speaks."""

from __future__ import annotations

import math
import time

from fluxvla_core.errors import Faulted
from fluxvla_core.ros2 import Stale

PAUSED = 0.01
"""Speed scaling below which the robot counts as paused."""
# ``safety_mode`` of the RTDE guide.
_SAFETY = {
    1: "normal",
    2: "reduced",
    3: "protective stop",
    4: "recovery",
    5: "safeguard stop",
    6: "system emergency stop",
    7: "robot emergency stop",
    8: "violation",
    9: "fault",
}
_MAY_MOVE = (1, 2)


def check_not_paused(scaling: float) -> None:
    """Refuse to command a robot that stands still until a person lets it continue.

    Args:
        scaling: share of the programmed speed that the robot runs at, 0 to 1.

    Raises:
        Faulted: it is paused; the commands would wait, and then be a jump.
    """
    if scaling < PAUSED:
        raise Faulted(
            "the robot is paused: its speed scaling is 0",
            cause="the speed slider is at 0, or a safeguard stop is active",
            next="look at the teach pendant",
        )


def check_safety(mode: int) -> None:
    """Refuse to command a robot that was stopped.

    Args:
        mode: ``safety_mode`` of the RTDE guide.

    Raises:
        Faulted: it ignores commands; says which stop it is in.
    """
    if mode not in _MAY_MOVE:
        raise Faulted(
            f"the robot is in {_SAFETY.get(mode, f'safety mode {mode}')}, and ignores commands",
            cause="it hit something, somebody pressed a stop, or a safety limit was reached",
            next="look at the teach pendant, see that the way is free, and clear the stop there",
        )


def check_age(name: str, receipt: float | None, max_age_s: float) -> None:
    """Refuse a stream that fell silent.

    Args:
        name: of the stream.
        receipt: when its last reading arrived (monotonic, s); None before any.
        max_age_s: how long it may be silent.

    Raises:
        Stale: it was silent for longer.
    """
    age = math.inf if receipt is None else time.monotonic() - receipt
    if age > max_age_s:
        raise Stale(
            f"{name} is silent for {age:.2f} s; {max_age_s:g} s is allowed",
            cause="the connection is gone, the device froze, or this machine is overloaded",
            next="look at the cable; max_age_s of the operator says how long it may be silent",
        )


def script_ended(watchdog_hz: float) -> Faulted:
    """The error of a controller on which the program that obeys commands does not run any more."""
    return Faulted(
        "the control script on the robot has ended, and nothing obeys commands",
        cause="a stop, local mode, a broken connection, or this program was silent for longer "
        f"than 1/watchdog_hz = {1 / watchdog_hz:g} s",
        next="look at the teach pendant, clear the stop, and start again",
    )
