"""Detect that a MuJoCo simulation diverged.

MuJoCo resets itself when it diverges and continues from the model's initial pose: everything is
finite again, and only a warning counter in its data, which a reset of the episode clears, shows it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fluxvla_core import Environment
from fluxvla_mujoco.drawing import drawn_by

WARNINGS = ("BADQPOS", "BADQVEL", "BADQACC", "BADCTRL")
"""Of ``mujoco.mjtWarning``: a position, velocity, acceleration or control is not finite, or beyond
1e10. After the first three MuJoCo resets itself; after the last it drops all controls."""


class MujocoEnvironment(Environment):
    """Base class of environments on MuJoCo: override ``simulation``."""

    @property
    def simulation(self) -> Any:
        """``mujoco.MjData`` of the episode; None where there is none."""
        return None

    def divergence(self) -> str | None:
        """Why the simulation diverged since the last reset; None if it did not."""
        return divergence(self.simulation)

    def drawn_by(self) -> str:
        """OpenGL backend and renderer of this process's images; "" before the first one."""
        return drawn_by()


def divergence(data: Any) -> str | None:
    """Why a MuJoCo simulation diverged since its last reset; None if it did not.

    For environments that do not inherit ``MujocoEnvironment``::

        def divergence(self):
            return fluxvla_mujoco.divergence(self.env.unwrapped.data)

    Args:
        data: ``mujoco.MjData``; None where there is no such simulation.
    """
    if data is None:
        return None
    import mujoco

    for name in WARNINGS:
        kind = getattr(mujoco.mjtWarning, f"mjWARN_{name}")
        if data.warning[kind].number:
            return f"MuJoCo warned of {name} at index {data.warning[kind].lastinfo}"
    for name in ("qpos", "qvel"):  # of the last step; MuJoCo looks when the next one begins
        if not np.isfinite(getattr(data, name)).all():
            return f"MuJoCo's {name} is not finite"
    return None
