"""What the teach pendant's speed slider means for who commands the arm."""

from __future__ import annotations

from fluxvla_core.errors import Faulted

PAUSED = 0.01
"""Speed scaling below which the robot counts as paused."""


def check_not_paused(scaling: float) -> None:
    """Refuse to command a robot that stands still until a person lets it go on.

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
