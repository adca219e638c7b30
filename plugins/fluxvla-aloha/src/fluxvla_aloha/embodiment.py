"""ALOHA: two arms with grippers, 14 numbers in, 14 numbers out. ``arms`` has their limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from fluxvla_aloha.arms import arms_called
from fluxvla_core.operators import Camera, EmbodimentSpec

RATE_HZ = 50.0
CAMERAS = (
    Camera("cam_high", 480, 640),
    Camera("cam_left_wrist", 480, 640),
    Camera("cam_right_wrist", 480, 640),
)

GRIPPERS: tuple[int, ...] = (6, 13)
"""Columns of the two grippers."""


def aloha_spec(
    cameras: Sequence[Camera] = CAMERAS, rate_hz: float = RATE_HZ, arms: str = "viperx300"
) -> EmbodimentSpec:
    """The embodiment of an ALOHA: left arm, then right arm, absolute joint targets.

    Args:
        cameras: the image streams there are, in the order of the images.
        rate_hz: commands a second.
        arms: ``viperx300``, ``arx_x5`` or ``piper``. Their joints have different names, so that no
            policy of one is taken for another's.

    Raises:
        ConfigError: there are no such arms here.
    """
    kind = arms_called(arms)
    return EmbodimentSpec(
        name=kind.robot,
        joints=tuple(
            replace(joint, name=f"{side}_{joint.name}")
            for side in ("left", "right")
            for joint in kind.joints
        ),
        cameras=tuple(cameras),
        rate_hz=rate_hz,
        source=kind.source,
    )


def start_pose(arms: str) -> tuple[float, ...]:
    """``(14,)`` where both arms may begin, grippers open: a ``prepare_pose``; rad and 0..1.

    Args:
        arms: as ``aloha_spec`` takes it.

    Raises:
        ConfigError: there are no such arms here.
    """
    return arms_called(arms).start * 2
