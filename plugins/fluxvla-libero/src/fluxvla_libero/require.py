"""Import LIBERO quietly, set to render without a display, or fail with instructions."""

from __future__ import annotations

import importlib.util
import io
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from types import ModuleType

from fluxvla_mujoco import use_egl

from fluxvla_core.errors import MissingPlugin, RunFailed

INSTALL = "pip install 'fluxvla-libero[libero]'"


def is_installed() -> bool:
    """Whether there is a LIBERO to import; imports nothing."""
    try:
        return importlib.util.find_spec("libero.libero") is not None
    except ModuleNotFoundError:
        return False


def require_libero() -> ModuleType:
    """The package ``libero.libero``, set to render by EGL if nothing else is set.

    Raises:
        MissingPlugin: it is not installed.
        RunFailed: it is, and cannot be imported, or was never set up; or EGL is wanted and missing.
    """
    if not is_installed():
        raise MissingPlugin(
            "LIBERO is not installed",
            cause="fluxvla-libero alone brings no simulator: its scenes are 340 MB",
            next=INSTALL,
        )
    use_egl()
    try:
        with quiet():
            import libero.libero
            import libero.libero.benchmark
            import libero.libero.envs
    except EOFError as error:
        raise RunFailed(
            "LIBERO was never set up here: it asks where its files are when it is first imported",
            next="python -c 'import libero.libero', and answer",
        ) from error
    except Exception as error:
        raise RunFailed(
            f"LIBERO is installed and cannot be imported: {type(error).__name__}: {error}",
            cause="a version of robosuite or mujoco that it was not written for",
            next=INSTALL,
        ) from error
    return libero.libero


@contextmanager
def quiet() -> Iterator[None]:
    """Without what LIBERO and robosuite print while they are imported and set up, and without an
    answer to what LIBERO would ask then: nobody would see the question."""
    log = logging.getLogger("robosuite_logs")
    before, stdin = log.level, sys.stdin
    log.setLevel(logging.ERROR)
    sys.stdin = io.StringIO()
    try:
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            yield
    finally:
        log.setLevel(before)
        sys.stdin = stdin
