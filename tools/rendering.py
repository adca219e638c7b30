"""Make MuJoCo render without a display, by installing Debian's Mesa if necessary."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

from tools import shell
from tools.envs import Env
from tools.shell import StepFailed

PROBE = Path(__file__).with_name("render_probe.py")
# libopengl0: PyOpenGL, which mujoco draws with, looks for the GL functions in it.
PACKAGES = ("libegl1", "libegl-mesa0", "libgl1-mesa-dri", "libopengl0")
# One software-rasteriser thread for each process: the processes already use all cores.
VARIABLES = {"MUJOCO_GL": "egl", "LP_NUM_THREADS": "1"}


class CannotRender(Exception):
    """Rendering does not work and may not be fixed from here; the text says what to type."""


def probe(env: Env) -> str | None:
    """None when a frame comes out right, else the reason in one line."""
    try:
        env.run("python", PROBE, env=VARIABLES, quiet=True, echo=False)
    except StepFailed as error:
        lines = [line.strip() for line in error.output.splitlines() if line.strip()]
        return lines[-1] if lines else f"the probe ended with exit status {error.status}"
    return None


def administrator() -> list[str] | None:
    """The words to put before a command that needs root: none, 'sudo -n', or None: not allowed."""
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        return []
    if shutil.which("sudo"):
        asked = subprocess.run(["sudo", "-n", "true"], capture_output=True, check=False)
        if asked.returncode == 0:
            return ["sudo", "-n"]
    return None


def ensure(env: Env, log: Callable[[str], None]) -> None:
    """Return when ``env`` can render; install Mesa first if need be and root rights allow it.

    Raises CannotRender with the one line to run by hand.
    """
    reason = probe(env)
    if reason is None:
        return
    if "No module named" in reason:
        raise CannotRender(f"{env.root} has no complete mujoco to render with: {reason}")
    rights = administrator()
    if shutil.which("apt-get") is None or rights is None:
        raise CannotRender(advice(reason, have_apt=shutil.which("apt-get") is not None))
    log(f"MuJoCo cannot render yet ({reason}): installing Mesa's software renderer")
    try:
        for command in apt_commands(rights):
            shell.run(command, env={"DEBIAN_FRONTEND": "noninteractive"}, quiet=True)
    except StepFailed as error:
        raise CannotRender(f"{advice(reason, have_apt=True)}\n{error}") from error
    reason = probe(env)
    if reason is not None:
        raise CannotRender(
            f"MuJoCo still cannot render after installing {' '.join(PACKAGES)}: {reason}"
        )


def apt_commands(rights: Sequence[str]) -> list[list[str]]:
    """The two commands that bring Mesa, with ``rights`` in front."""
    apt = [*rights, "apt-get"]
    return [
        [*apt, "update", "-q"],
        [*apt, "install", "-y", "-q", "--no-install-recommends", *PACKAGES],
    ]


def advice(reason: str, *, have_apt: bool) -> str:
    """Instructions for a user whose machine cannot render."""
    head = f"MuJoCo cannot render without a display: {reason}\n"
    if have_apt:
        line = " && ".join(" ".join(command) for command in apt_commands(["sudo"]))
        return f"{head}Run this line, then the same command again:\n\n    {line}\n"
    return (
        f"{head}Install EGL and Mesa's software renderer (on Debian: {' '.join(PACKAGES)}) "
        "with this system's package manager, then run the same command again."
    )
