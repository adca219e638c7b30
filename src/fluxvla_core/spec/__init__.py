"""Embodiment specs: what a robot's numbers mean."""

from fluxvla_core.spec.embodiment import (
    Camera,
    EmbodimentSpec,
    Joint,
    check_match,
    differences,
)

__all__ = ["Camera", "EmbodimentSpec", "Joint", "check_match", "differences"]
