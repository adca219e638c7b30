"""Which build of torch an environment gets: without a GPU the CPU one, a tenth of the size."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from tools.envs import Env
from tools.shell import StepFailed


def nvidia_gpus() -> int:
    """How many GPUs ``nvidia-smi`` reports; 0 where there is no such program."""
    program = shutil.which("nvidia-smi")
    if program is None:
        return 0
    try:
        listing = subprocess.run([program, "-L"], capture_output=True, text=True, timeout=30)
    except (OSError, subprocess.TimeoutExpired):
        return 0
    if listing.returncode:
        return 0
    return sum(line.startswith("GPU ") for line in listing.stdout.splitlines())


def attempts(version: str, *, gpu: bool, platform: str = sys.platform) -> list[str]:
    """The ways to install torch, best first: 'cpu-wheel', 'uv', 'plain'.

    'cpu-wheel' works where pip is configured to see an index with CPU builds; uv knows the place
    of these builds by itself; 'plain' is the package index's default build, which on Linux
    brings the CUDA libraries along. Only Linux has two builds of one version.
    """
    if gpu or platform != "linux" or "+" in version:
        return ["plain"]
    return ["cpu-wheel", "uv", "plain"]


def install(env: Env, version: str, constraints: Path | None, log: Callable[[str], None]) -> str:
    """Install torch into ``env``; return the attempt that worked. Raises StepFailed from the last.

    ``constraints`` may hold ``torch==VERSION``: that admits ``VERSION+cpu`` as well.
    """
    ways = attempts(version, gpu=nvidia_gpus() > 0)
    reasons: list[str] = []
    for way in ways[:-1]:
        try:
            _quietly(env, way, version, constraints)
        except StepFailed as error:
            reasons.append(f"{way}: {_first_error(error.output) or error}")
            continue
        return way
    if reasons:
        log(
            f"no CPU build of torch {version} found ({'; '.join(reasons)}): installing the "
            "default build, which also works without a GPU but is several GB larger"
        )
    env.pip_install(f"torch=={version}", constraints=constraints)
    return ways[-1]


def _quietly(env: Env, way: str, version: str, constraints: Path | None) -> None:
    if way == "cpu-wheel":
        env.pip_install(f"torch=={version}+cpu", constraints=constraints, quiet=True)
        return
    env.pip_install("uv", quiet=True)
    uv = ["uv", "pip", "install", "-q", "--python", str(env.python), "--torch-backend=cpu"]
    if constraints is not None:
        uv += ["-c", str(constraints)]
    env.run(*uv, f"torch=={version}", quiet=True)


def _first_error(text: str) -> str:
    """The line that says what went wrong; tools add hints and causes of causes after it."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    errors = [line for line in lines if "error" in line.lower()]
    return (errors or lines or [""])[0]
