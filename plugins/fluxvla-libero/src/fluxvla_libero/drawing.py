"""Pictures of a scene, drawn when they are asked for and at the price of a control loop.

LIBERO's own environment draws both cameras in every step, with MuJoCo's default quality (4096-pixel
shadow maps, 4x multisampling). ``render='cheap'`` turns both off; ``'reference'`` gives the stock
pictures, byte for byte.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import ConfigError, RunFailed
from fluxvla_libero.require import APT

RENDERS = ("cheap", "reference")

# As robosuite shows a scene: visual shapes (group 1), no collision shapes (group 0).
_GROUPS = {0: 0, 1: 1}


def check_render(render: str) -> None:
    """Refuse an unknown quality.

    Raises:
        ConfigError: it lists those that there are.
    """
    if render not in RENDERS:
        raise ConfigError(f"render {render!r} is none of {', '.join(RENDERS)}")


class Drawing:
    """Draws one model; contexts are made when first needed, one for each size.

    Args:
        model: ``mujoco.MjModel``; its quality settings are changed in place.
        render: ``cheap`` or ``reference``.
    """

    def __init__(self, model: Any, render: str) -> None:
        check_render(render)
        self._model = model
        if render == "cheap":
            model.vis.quality.shadowsize = 0
            model.vis.quality.offsamples = 0
        self._renderers: dict[tuple[int, int], Any] = {}
        self._option: Any = None

    def picture(self, data: Any, camera: str, height: int, width: int) -> npt.NDArray[np.uint8]:
        """A new ``(height, width, 3)`` uint8 RGB array, turned by 180 degrees.

        The public LIBERO datasets show robosuite's pictures, which are upside down, turned by 180
        degrees: upright, with left and right exchanged.

        Raises:
            RunFailed: nothing here can draw.
        """
        renderer = self._renderer(height, width)
        renderer.update_scene(data, camera, self._option)
        mirrored: npt.NDArray[np.uint8] = renderer.render()[:, ::-1]
        return np.ascontiguousarray(mirrored)

    def close(self) -> None:
        """Free the contexts; any number of times."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers = {}

    def _renderer(self, height: int, width: int) -> Any:
        found = self._renderers.get((height, width))
        if found is not None:
            return found
        import mujoco

        self._option = mujoco.MjvOption()
        for group, shown in _GROUPS.items():
            self._option.geomgroup[group] = shown
        vis = self._model.vis.global_
        vis.offheight, vis.offwidth = max(vis.offheight, height), max(vis.offwidth, width)
        try:
            made = mujoco.Renderer(self._model, height, width)
        # PyOpenGL and mujoco raise ImportError, RuntimeError and classes of their own here.
        except Exception as error:
            raise RunFailed(
                f"the simulator cannot draw: no OpenGL context could be made ({error})",
                cause="no EGL driver is installed, or none works without a display",
                next=APT,
            ) from error
        self._renderers[height, width] = made
        return made
