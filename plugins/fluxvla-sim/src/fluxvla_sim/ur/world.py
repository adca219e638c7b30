"""The world of the simulated UR5e: one cube on a table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from fluxvla_ur.embodiment import ur_spec

from fluxvla_sim.ur.expert import URExpert, lift_noise
from fluxvla_sim.ur.scene import MAX_STEPS, LiftCube, LiftFacts, URScene
from fluxvla_sim.world import CONTROL_HZ, SimRobot, SimWorld

if TYPE_CHECKING:
    from fluxvla_core.operators import Camera, EmbodimentSpec

CUBE = SimWorld(
    tasks=(LiftCube(),),
    max_steps=MAX_STEPS,
    open_scene=URScene,
    open_expert=URExpert,
    begin=LiftFacts,
    noise=lift_noise,
)


def _embodiment(cameras: Sequence[Camera]) -> EmbodimentSpec:
    return ur_spec("ur5e", cameras, CONTROL_HZ)


UR5E = SimRobot(
    name="ur5e",
    title="UR5e",
    cameras=("front", "wrist"),
    embodiment=_embodiment,
    worlds=(CUBE,),
    default_tasks=("lift_cube",),
)
