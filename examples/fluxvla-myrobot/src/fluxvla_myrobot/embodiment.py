"""The arm's seven numbers; ``configs/myrobot.py`` says the same in the config's words."""

from __future__ import annotations

from fluxvla_core import Camera, EmbodimentSpec, Joint
from fluxvla_myrobot.topics import SIZE, STROKE

SPEC = EmbodimentSpec(
    name="myrobot",
    joints=(
        *(Joint(f"joint_{n}", "rad", -3.14, 3.14, 2.0, 10.0) for n in range(1, 7)),
        Joint("gripper", "m", 0.0, STROKE, 0.2, 2.0, kind="gripper", open=STROKE, closed=0.0),
    ),
    cameras=(Camera("cam_front", SIZE, SIZE), Camera("cam_wrist", SIZE, SIZE)),
    rate_hz=30.0,
    source="invented for the example",
)
