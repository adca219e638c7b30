"""Embodiments of the two robots of this example: joints, limits, cameras."""

from __future__ import annotations

from fluxvla_core import Camera, EmbodimentSpec, Joint

SIZE = 32
STROKE = 0.085
HOME = (0.0, -1.57, 1.57, 0.0, 1.57, 0.0, STROKE)

SPEC = EmbodimentSpec(
    name="myrobot",
    joints=(
        *(Joint(f"joint_{n}", "rad", -3.14, 3.14, 2.0, 10.0) for n in range(1, 7)),
        Joint("gripper", "m", 0.0, STROKE, 0.15, 2.0, kind="gripper", open=STROKE, closed=0.0),
    ),
    cameras=(Camera("cam_front", SIZE, SIZE), Camera("cam_wrist", SIZE, SIZE)),
    rate_hz=30.0,
    source="invented for the example",
)


def _arm(side: str) -> tuple[Joint, ...]:
    joints = tuple(Joint(f"{side}_joint_{n}", "rad", -1.7, 1.7, 2.0, 10.0) for n in range(1, 7))
    jaw = Joint(f"{side}_jaw", "normalized", 0, 1, 2.0, 20.0, kind="gripper", open=1.0, closed=0.0)
    return (*joints, jaw)


DUAL_ARM = EmbodimentSpec(
    name="mydualarm",
    joints=(*_arm("left"), *_arm("right")),
    cameras=(Camera("cam_front", SIZE, SIZE),),
    rate_hz=50.0,
    source="invented for the example",
)
