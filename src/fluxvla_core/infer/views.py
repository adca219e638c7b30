"""Whether a robot's cameras show what the policy was trained on."""

from __future__ import annotations

from collections.abc import Sequence

from fluxvla_core.errors import SpecMismatch
from fluxvla_core.spec.embodiment import EmbodimentSpec


def scaled_views(trained: EmbodimentSpec, here: EmbodimentSpec, names: Sequence[str]) -> list[str]:
    """A camera may have more pixels than in training; it may not show another view.

    Args:
        trained, here: the embodiments of the policy and of the robot.
        names: the cameras that the policy looks at.

    Returns:
        What is to be said of pictures that are scaled.

    Raises:
        SpecMismatch: a camera's pictures have another aspect.
    """
    cameras = {camera.name: camera for camera in here.cameras}
    said = []
    for then in trained.cameras:
        now = cameras.get(then.name)
        if then.name not in names or now is None:
            continue
        if (now.height, now.width) == (then.height, then.width):
            continue
        sizes = (
            f"camera {then.name} gives {now.height} x {now.width} pictures; the policy was "
            f"trained on {then.height} x {then.width}"
        )
        difference = abs(now.width * then.height - then.width * now.height)
        if difference > 0.01 * now.height * then.width:
            raise SpecMismatch(
                f"{sizes}: another view",
                next="set the camera to the size, or at least the aspect, of the recordings",
            )
        said.append(f"{sizes}; they are scaled")
    return said
