"""Images from MuJoCo without a window, from any thread, in any size.

A robot's scene is drawn by several threads: the one that observes, the one that records, the
cameras' thread of a ROS 2 node. What qualities there are and what they cost is in
``fluxvla_mujoco.drawing``.
"""

from __future__ import annotations

import atexit
import os
import sys
import weakref
from typing import Any

import numpy as np
import numpy.typing as npt
from fluxvla_mujoco import no_context, note_renderer, use_egl


def import_mujoco() -> Any:
    """The ``mujoco`` module, set to use EGL if nothing else is set.

    Raises:
        RunFailed: EGL is wanted and its library is not installed.
    """
    use_egl()
    import mujoco

    return mujoco


def _gl_context_class(mujoco: Any) -> Any:
    if sys.platform != "linux" or os.environ.get("MUJOCO_GL", "egl").lower() != "egl":
        return mujoco.GLContext
    # The first import of mujoco chose its default backend; this class works with any.
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    from mujoco.egl import GLContext

    return GLContext


class Renderer:
    """One OpenGL context for one model: any camera, any size; it grows with the largest.

    Any thread may draw, one at a time: the context is given back after each image.

    Args:
        model: ``mujoco.MjModel``, whose quality is set by then.

    Raises:
        RunFailed: nothing here can draw.
    """

    def __init__(self, model: Any) -> None:
        mujoco = import_mujoco()
        self._mujoco = mujoco
        self._model = model
        self._gl: Any = None
        self._context: Any = None
        self._open()
        # Before mujoco's own handler shuts EGL down; after it, freeing only prints tracebacks.
        atexit.register(_close_at_exit, weakref.ref(self))
        self._scene = mujoco.MjvScene(model, maxgeom=2000)
        self._option = mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED

    def render(self, data: Any, camera: str, height: int, width: int) -> npt.NDArray[np.uint8]:
        """A new ``(height, width, 3)`` uint8 RGB array of what ``camera`` sees.

        Args:
            data: ``mujoco.MjData`` whose kinematics are up to date.

        Raises:
            ValueError: the model has no such camera.
            RunFailed: an image of this size cannot be drawn here.
        """
        return self._draw(data, camera, height, width, None)

    def render_with_depth(
        self, data: Any, camera: str, height: int, width: int
    ) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.float32]]:
        """The image of ``render`` and its depth, ``(height, width)`` float32 metres.

        They are along the camera's axis, as depth cameras measure, and NaN where nothing is.
        """
        buffer = np.empty((height, width), np.float32)
        image = self._draw(data, camera, height, width, buffer)
        extent, planes = self._model.stat.extent, self._model.vis.map
        near, far = planes.znear * extent, planes.zfar * extent
        # 0 at the far plane and 1 at the near one, as mjDEPTH_ZEROFAR has it.
        metres = near * far / (near + buffer[::-1].astype(np.float64) * (far - near))
        return image, np.where(buffer[::-1] > 0, metres, np.nan).astype(np.float32)

    def _draw(
        self,
        data: Any,
        camera: str,
        height: int,
        width: int,
        depth: npt.NDArray[np.float32] | None,
    ) -> npt.NDArray[np.uint8]:
        mujoco, vis = self._mujoco, self._model.vis.global_
        if height > vis.offheight or width > vis.offwidth:
            self.close()
            vis.offheight, vis.offwidth = max(vis.offheight, height), max(vis.offwidth, width)
        if self._gl is None:
            self._open()
        index = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_CAMERA.value, camera)
        if index < 0:
            names = [self._model.camera(i).name for i in range(self._model.ncam)]
            raise ValueError(f"the scene has no camera {camera!r}; it has {', '.join(names)}")
        self._camera.fixedcamid = index
        self._gl.make_current()
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(
            self._model, data, self._option, None, self._camera, everything, self._scene
        )
        rect = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(rect, self._scene, self._context)
        bottom_up = np.empty((height, width, 3), np.uint8)
        mujoco.mjr_readPixels(bottom_up, depth, rect, self._context)
        _release_current_context()
        return np.ascontiguousarray(bottom_up[::-1])

    def close(self) -> None:
        """Free the context; any number of times. The next image makes another."""
        if self._gl is not None:
            self._gl.make_current()
            if self._context is not None:
                self._context.free()
            self._gl.free()
            self._gl = self._context = None

    def _open(self) -> None:
        mujoco, vis = self._mujoco, self._model.vis.global_
        try:
            self._gl = _gl_context_class(mujoco)(vis.offwidth, vis.offheight)
            self._gl.make_current()
            scale = mujoco.mjtFontScale.mjFONTSCALE_100.value
            self._context = mujoco.MjrContext(self._model, scale)
        # PyOpenGL and mujoco raise ImportError, RuntimeError and classes of their own here.
        except Exception as error:
            raise no_context(error) from error
        note_renderer()
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        # The other way round rounds what is far to one distance.
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        _release_current_context()


def _close_at_exit(reference: weakref.ref[Renderer]) -> None:
    renderer = reference()
    if renderer is not None:
        renderer.close()


def _release_current_context() -> None:
    """Let another thread make this thread's EGL context its own; other platforms have no need."""
    egl = sys.modules.get("mujoco.egl")
    if egl is not None:
        nothing = egl.EGL.EGL_NO_SURFACE
        egl.EGL.eglMakeCurrent(egl.EGL_DISPLAY, nothing, nothing, egl.EGL.EGL_NO_CONTEXT)


class DrawnScene:
    """A scene with images; a subclass sets ``model`` and ``data``."""

    model: Any
    data: Any
    _renderer: Renderer | None = None

    def render(self, camera: str, height: int, width: int) -> npt.NDArray[np.uint8]:
        """A new ``(height, width, 3)`` uint8 RGB image."""
        if self._renderer is None:
            self._renderer = Renderer(self.model)
        return self._renderer.render(self.data, camera, height, width)

    def close(self) -> None:
        """Free the renderer; any number of times."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
