"""Images of a MuJoCo scene, drawn when they are asked for and at the price of a control loop.

Simulators draw with MuJoCo's default quality: 4096-pixel shadow maps and 4x multisampling, which
take about ten times as long as the image itself on a software renderer. ``render='cheap'`` turns
both off; ``'reference'`` gives the stock images, byte for byte. ``'coarse'`` is cheap, and draws
meshes with details below 6 mm left out: where they are scans of hundreds of thousands of faces that
is several times as fast again, and close-ups look chipped. Which one it was belongs into whatever
is reported about the images.

Importing this module imports no simulator.
"""

from __future__ import annotations

import ctypes
import os
import sys
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import ConfigError, RunFailed

RENDERS = ("cheap", "coarse", "reference")
DETAIL = 0.006
"""Metres; what is smaller is left out of coarse images."""
_FEW_FACES = 500
APT = "apt-get install -y libegl1 libegl-mesa0 libgl1-mesa-dri libopengl0"


def check_render(render: str) -> None:
    """Refuse an unknown quality.

    Raises:
        ConfigError: it lists those that there are.
    """
    if render not in RENDERS:
        raise ConfigError(f"render {render!r} is unknown; choose one of {', '.join(RENDERS)}")


def set_render(model: Any, render: str) -> None:
    """Set a ``mujoco.MjModel``'s quality in place, before anything has drawn it."""
    check_render(render)
    if render != "reference":
        model.vis.quality.shadowsize = 0
        model.vis.quality.offsamples = 0
    if render == "coarse":
        coarsen(model, DETAIL)


def coarsen(model: Any, detail: float) -> None:
    """Draw the meshes of a ``mujoco.MjModel`` with fewer faces, by vertex clustering (Rossignac
    and Borrel 1993): a face's corners move to the first vertex of the cell that each lies in, and
    faces of less than three cells go. Vertices and hulls stay, and with them the physics.

    Args:
        model: changed in place, before anything has drawn it.
        detail: side of a cell, m.
    """
    for mesh in range(model.nmesh):
        count = int(model.mesh_facenum[mesh])
        if count < _FEW_FACES:
            continue
        faces = slice(model.mesh_faceadr[mesh], model.mesh_faceadr[mesh] + count)
        first = model.mesh_vertadr[mesh]
        vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
        cells = np.floor(vertices / detail).astype(np.int64)
        _, leaders, cell_of = np.unique(cells, axis=0, return_index=True, return_inverse=True)
        corners = leaders[cell_of.reshape(-1)[model.mesh_face[faces]]]
        ordered = np.sort(corners, axis=1)
        whole = np.flatnonzero((np.diff(ordered, axis=1) > 0).all(axis=1))
        _, unique = np.unique(ordered[whole], axis=0, return_index=True)
        kept = whole[np.sort(unique)]
        for values in (model.mesh_facenormal, model.mesh_facetexcoord):
            values[faces][: len(kept)] = values[faces][kept]
        model.mesh_face[faces][: len(kept)] = corners[kept]
        model.mesh_facenum[mesh] = len(kept)


def use_egl() -> None:
    """Before ``mujoco`` is imported: on Linux draw by EGL, without a display, if nothing else was
    said by ``MUJOCO_GL``.

    Raises:
        RunFailed: EGL is wanted and missing.
    """
    if sys.platform != "linux":
        return
    os.environ.setdefault("MUJOCO_GL", "egl")
    if os.environ["MUJOCO_GL"].lower() != "egl" or "mujoco" in sys.modules:
        return
    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError as error:
        raise RunFailed(
            f"the simulator cannot draw: libEGL.so.1 cannot be loaded ({error})",
            cause="Mesa's EGL is not installed",
            next=APT,
        ) from error


def no_context(error: Exception) -> RunFailed:
    """The error to raise where MuJoCo or PyOpenGL could not make an OpenGL context."""
    return RunFailed(
        f"the simulator cannot draw: no OpenGL context could be made ({error})",
        cause="no EGL driver is installed, or none works without a display",
        next=APT,
    )


_drawn_by: set[str] = set()


def note_renderer() -> None:
    """Remember what draws; called where an OpenGL context is current.

    In a module-wide set, because contexts are made in many places and images say nothing of it.
    """
    try:
        from OpenGL import GL

        name = GL.glGetString(GL.GL_RENDERER)
    # PyOpenGL raises classes of its own without a context, and cannot be imported without a driver.
    except Exception:  # noqa: BLE001
        return
    if name:
        backend = os.environ.get("MUJOCO_GL") or "the platform's own OpenGL"
        _drawn_by.add(f"{backend}: {name.decode(errors='replace')}")


def drawn_by() -> str:
    """GL backend and renderer of this process's images, ``egl: llvmpipe (…)``; "" without any."""
    return "; ".join(sorted(_drawn_by))


class Drawing:
    """Draws one model; contexts are made when first needed, one for each size.

    Args:
        model: ``mujoco.MjModel``; its quality settings are changed in place.
        render: one of ``RENDERS``.
        groups: MuJoCo's groups of shapes to show or to hide, where that is not its default.
    """

    def __init__(self, model: Any, render: str, groups: Mapping[int, int] | None = None) -> None:
        set_render(model, render)
        self._model = model
        self._groups = dict(groups or {})
        self._renderers: dict[tuple[int, int], Any] = {}
        self._option: Any = None

    def image(self, data: Any, camera: str, height: int, width: int) -> npt.NDArray[np.uint8]:
        """A new ``(height, width, 3)`` uint8 RGB array of what ``camera`` sees, its top row first.

        Args:
            data: ``mujoco.MjData`` whose kinematics are up to date.

        Raises:
            RunFailed: nothing here can draw.
        """
        renderer = self._renderer(height, width)
        renderer.update_scene(data, camera, self._option)
        seen: npt.NDArray[np.uint8] = renderer.render()
        return seen.copy()

    def picture(self, data: Any, camera: str, height: int, width: int) -> npt.NDArray[np.uint8]:
        """Deprecated name of :meth:`image`."""
        message = "Drawing.picture is deprecated, use image"
        warnings.warn(message, DeprecationWarning, stacklevel=2)
        return self.image(data, camera, height, width)

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
        for group, shown in self._groups.items():
            self._option.geomgroup[group] = shown
        vis = self._model.vis.global_
        vis.offheight, vis.offwidth = max(vis.offheight, height), max(vis.offwidth, width)
        try:
            made = mujoco.Renderer(self._model, height, width)
        # PyOpenGL and mujoco raise ImportError, RuntimeError and classes of their own here.
        except Exception as error:
            raise no_context(error) from error
        note_renderer()
        self._renderers[height, width] = made
        return made
