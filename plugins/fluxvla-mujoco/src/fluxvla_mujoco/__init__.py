"""Rendering and divergence checks for environments on MuJoCo. Importing it imports no simulator."""

from __future__ import annotations

from fluxvla_mujoco.drawing import (
    APT,
    RENDERS,
    Drawing,
    check_render,
    drawn_by,
    no_context,
    note_renderer,
    set_render,
    use_egl,
)
from fluxvla_mujoco.environment import MujocoEnvironment, divergence

__all__ = [
    "APT",
    "RENDERS",
    "Drawing",
    "MujocoEnvironment",
    "check_render",
    "divergence",
    "drawn_by",
    "no_context",
    "note_renderer",
    "set_render",
    "use_egl",
]
