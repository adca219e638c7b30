"""Pictures from MuJoCo without a window, at the price that a control loop can afford.

MuJoCo's default quality (4096-pixel shadow maps, 4x multisampling) costs about ten times as much as
the picture itself on a software renderer, whatever the resolution. ``quality='cheap'`` turns both
off; ``'reference'`` keeps what the model file asks for.

On Linux everything is drawn by EGL, which needs no display, unless ``MUJOCO_GL`` says otherwise.
"""

from __future__ import annotations

import atexit
import ctypes
import os
import sys
import weakref
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import RunFailed

QUALITIES = ("cheap", "reference")
APT = "apt-get install -y libegl1 libegl-mesa0 libgl1-mesa-dri libopengl0"
_EGL = "libEGL.so.1"


def import_mujoco() -> Any:
    """The ``mujoco`` module, told to use EGL if it has not been told anything.

    Raises:
        RunFailed: EGL is wanted and its library is not installed.
    """
    if sys.platform == "linux":
        os.environ.setdefault("MUJOCO_GL", "egl")
    if _wants_egl() and "mujoco" not in sys.modules:
        _check_egl()
    import mujoco

    return mujoco


def _wants_egl() -> bool:
    return sys.platform == "linux" and os.environ.get("MUJOCO_GL", "egl").lower() == "egl"


def _check_egl() -> None:
    try:
        ctypes.CDLL(_EGL)
    except OSError as error:
        raise RunFailed(
            f"the simulator cannot draw: {_EGL} cannot be loaded ({error})",
            cause="Mesa's EGL is not installed",
            next=APT,
        ) from error


def _gl_context_class(mujoco: Any) -> Any:
    if not _wants_egl():
        return mujoco.GLContext
    # Whoever imported mujoco first chose its default; this class works whatever that was.
    _check_egl()
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    from mujoco.egl import GLContext

    return GLContext


def set_quality(model: Any, quality: str, height: int, width: int) -> None:
    """Prepare ``model`` for drawing; only has an effect before its first :class:`Renderer`.

    Args:
        model: ``mujoco.MjModel``, changed in place.
        quality: ``cheap`` or ``reference``.
        height, width: the largest picture that will be asked for, in pixels.
    """
    if quality not in QUALITIES:
        raise ValueError(f"quality {quality!r} is none of {QUALITIES}")
    if quality == "cheap":
        model.vis.quality.shadowsize = 0
        model.vis.quality.offsamples = 0
    model.vis.global_.offheight = max(model.vis.global_.offheight, height)
    model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)


class Renderer:
    """One OpenGL context for one model: any camera, any size up to the model's buffer.

    Any thread may draw, one at a time: the context is given back after each picture.
    """

    def __init__(self, model: Any) -> None:
        mujoco = import_mujoco()
        self._mujoco = mujoco
        self._model = model
        self._gl: Any = None
        try:
            make_context = _gl_context_class(mujoco)
            self._gl = make_context(model.vis.global_.offwidth, model.vis.global_.offheight)
            self._gl.make_current()
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        except RunFailed:
            raise
        # PyOpenGL and mujoco raise ImportError, RuntimeError and classes of their own here.
        except Exception as error:
            raise RunFailed(
                f"the simulator cannot draw: no OpenGL context could be made ({error})",
                cause="no EGL driver is installed, or none works without a display",
                next=APT,
            ) from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        _release_current_context()
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
            ValueError: the model has no such camera, or its buffer is smaller than the picture.
        """
        mujoco, vis = self._mujoco, self._model.vis.global_
        if height > vis.offheight or width > vis.offwidth:
            raise ValueError(
                f"{height}x{width} is larger than the buffer {vis.offheight}x{vis.offwidth}; "
                "give set_quality the largest size"
            )
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
        mujoco.mjr_readPixels(bottom_up, None, rect, self._context)
        _release_current_context()
        return np.ascontiguousarray(bottom_up[::-1])

    def close(self) -> None:
        """Free the context; any number of times."""
        if self._gl is not None:
            self._gl.make_current()
            self._context.free()
            self._gl.free()
            self._gl = None


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
