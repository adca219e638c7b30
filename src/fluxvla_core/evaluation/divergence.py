"""Refuse the outcome of an episode whose simulation diverged.

A simulation that diverges says nothing about a policy, whatever its task's test makes of it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.environment import Environment
from fluxvla_core.errors import RunFailed


class Diverged(RunFailed):
    """A simulation's state is not finite, or was not within a step."""


def check_step(environment: Environment, steps: int) -> npt.NDArray[np.float64]:
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
