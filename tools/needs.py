"""System packages without which some tests would be skipped silently."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass

from tools import shell
from tools.rendering import administrator

ANYWAY = "FLUXVLA_TEST_WITHOUT"
"""An environment variable: names of needs, separated by commas, that are to be done without."""
LIBPYTHON = f"libpython{sys.version_info[0]}.{sys.version_info[1]}"


@dataclass(frozen=True)
class Need:
    """One thing: its name, Debian's package, which tests are skipped without it, whether it is
    there."""

    name: str
    package: str
    why: str
    there: Callable[[], bool]


class Lacking(Exception):
    """Something is missing and may not be installed from here; the text says what to type."""


def has_compiler() -> bool:
    return any(shutil.which(name) for name in ("g++", "c++", "clang++"))


def has_libpython() -> bool:
    """Whether a library that links to libpython can be loaded by this Python."""
    code = f"import ctypes; ctypes.CDLL('{LIBPYTHON}.so.1.0')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    return done.returncode == 0


NEEDS = (
    Need("compiler", "g++", "torch.compile cannot be tested", has_compiler),
    Need("libpython", LIBPYTHON, "nothing can be compared with LeRobot", has_libpython),
)


def ensure(log: Callable[[str], None], needs: tuple[Need, ...] = NEEDS) -> None:
    """Return when all that is needed is there; install it first where root rights allow it.

    Raises:
        Lacking: with the line to run by hand, and how to do without.
    """
    if sys.platform != "linux":
        return
    without = {name.strip() for name in os.environ.get(ANYWAY, "").split(",")}
    lacking = [need for need in needs if need.name not in without and not need.there()]
    if not lacking:
        return
    rights = administrator() if shutil.which("apt-get") else None
    reason = ""
    if rights is not None:
        packages = [need.package for need in lacking]
        log(f"installing what the tests need: {', '.join(packages)}")
        apt = [*rights, "apt-get"]
        try:
            shell.run([*apt, "update", "-q"], quiet=True)
            shell.run(
                [*apt, "install", "-y", "-q", "--no-install-recommends", *packages], quiet=True
            )
        except shell.StepFailed as error:
            reason = f"\n{error}"
        lacking = [need for need in lacking if not need.there()]
    if lacking:
        raise Lacking(advice(lacking) + reason)


def advice(lacking: list[Need]) -> str:
    """Instructions for a developer whose machine lacks something."""
    lines = [f"  {need.name}: {need.why} without it (Debian: {need.package})" for need in lacking]
    packages = " ".join(need.package for need in lacking)
    names = ",".join(need.name for need in lacking)
    return "\n".join(
        [
            "the tests need what is not there:",
            *lines,
            "Install it, then run the same command again:\n",
            f"    sudo apt-get install -y {packages}\n",
            f"or do without, and have those tests skipped: {ANYWAY}={names} nox -s tests",
        ]
    )
