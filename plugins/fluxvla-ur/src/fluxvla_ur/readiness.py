"""Checks of a UR's safety mode and speed scaling: whether it may be commanded."""

from __future__ import annotations

from fluxvla_core.errors import Faulted

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
