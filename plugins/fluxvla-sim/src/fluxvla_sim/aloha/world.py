"""The worlds of the simulated ALOHA: one cube, or a peg and a socket."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from fluxvla_aloha.embodiment import aloha_spec

from fluxvla_sim.aloha.cube import (
    MAX_STEPS,
    AlohaScene,
    Expert,
    Facts,
    LiftHold,
    TransferCube,
    smooth_noise,
)
from fluxvla_sim.aloha.insertion import (
    Insertion,
    InsertionExpert,
    InsertionFacts,
    InsertionScene,
    insertion_noise,
)
from fluxvla_sim.world import CONTROL_HZ, SimRobot, SimWorld

if TYPE_CHECKING:
    from fluxvla_core.operators import Camera, EmbodimentSpec

CAMERAS = (
    "top",
    "left_wrist",
    "right_wrist",
    "angle",
    "front_close",
    "left_pillar",
    "right_pillar",
)
CUBE = SimWorld(
    tasks=(TransferCube(), LiftHold()),
    max_steps=MAX_STEPS,
    open_scene=AlohaScene,
    open_expert=Expert,
    begin=Facts,
    noise=smooth_noise,
)
INSERTION = SimWorld(
    tasks=(Insertion(),),
    max_steps=MAX_STEPS,
    open_scene=InsertionScene,
    open_expert=InsertionExpert,
    begin=InsertionFacts,
    noise=insertion_noise,
)


def _embodiment(cameras: Sequence[Camera]) -> EmbodimentSpec:
    return aloha_spec(cameras, CONTROL_HZ)


ALOHA = SimRobot(
    name="aloha",
    title="ALOHA",
    cameras=CAMERAS,
    embodiment=_embodiment,
    worlds=(CUBE, INSERTION),
    default_tasks=("lift_hold", "transfer_cube"),
)
