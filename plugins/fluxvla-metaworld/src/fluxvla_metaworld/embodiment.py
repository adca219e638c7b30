"""Embodiment of Meta-World: a Sawyer arm whose hand is moved by small steps."""

from __future__ import annotations

from collections.abc import Sequence

from fluxvla_core.operators import Camera, EmbodimentSpec, Joint

CONTROL_HZ = 80.0
"""Five simulation steps of 2.5 ms."""

CAMERAS: Sequence[str] = (
    "corner",
    "corner2",
    "corner3",
    "corner4",
    "topview",
    "behindGripper",
    "gripperPOV",
)
TURNED = frozenset({"corner", "corner2", "corner3", "corner4"})
"""Cameras that hang upside down in Meta-World's scenes; their images are turned by 180 degrees,
as public datasets of Meta-World show ``corner2``."""

IMAGE_SIZE = 224


def metaworld_spec(cameras: Sequence[Camera]) -> EmbodimentSpec:
    """Meta-World's Sawyer.

    Actions move the hand for one control step along the world's axes (1 is 0.01 m), its
    orientation stays; the fourth is the fingers' effort, -1 opens and 1 closes. The state is the
    hand's position in the world (m) and how far the fingers are apart (1 is 0.1 m).
    Limits are those of ``SawyerXYZEnv`` in metaworld 3.1.
    """
    return EmbodimentSpec(
        name="metaworld_sawyer",
        joints=(
            *(
                Joint(name, "normalized", -1.0, 1.0, 160.0, 25_600.0, "prismatic")
                for name in ("dx", "dy", "dz")
            ),
            Joint("gripper", "normalized", -1.0, 1.0, 160.0, 25_600.0, "gripper", -1.0, 1.0),
        ),
        cameras=tuple(cameras),
        rate_hz=CONTROL_HZ,
        action_mode="delta",
        frame="world",
        source="metaworld 3.1 SawyerXYZEnv",
        state_joints=(
            Joint("x", "m", -0.525, 0.525, 2.0, 50.0, "prismatic"),
            Joint("y", "m", 0.348, 1.025, 2.0, 50.0, "prismatic"),
            Joint("z", "m", -0.0525, 0.7, 2.0, 50.0, "prismatic"),
            Joint("fingers", "normalized", 0.0, 1.0, 20.0, 2000.0, "gripper", 1.0, 0.0),
        ),
    )
