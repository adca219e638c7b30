"""LeRobot's environment for the benchmarks that compare with it."""

from __future__ import annotations

import sys
from importlib.metadata import distributions

from tools import lerobot_env, shell
from tools.envs import Env
from tools.project import ROOT

PARTS = ("lerobot", "torch", "torchvision", "torchcodec", "accelerate", "datasets")


def prepared(*requirements: str, folder: str = "lerobot") -> Env | None:
    """The environment ``.nox/<folder>`` with these requirements too.

    None where it cannot be installed, which is said: the comparison is left out then.
    """
    try:
        env = lerobot_env.prepare(lambda text: print(text, file=sys.stderr), ROOT / ".nox" / folder)
        if requirements:
            env.pip_install(*requirements, quiet=True)
    except (shell.StepFailed, OSError) as error:
        print(f"without LeRobot, which cannot be installed: {error}", file=sys.stderr)
        return None
    return env


def versions(env: Env | None) -> dict[str, dict[str, str]]:
    """Of LeRobot and what it computes with, as ``lerobot_versions`` of a results file."""
    if env is None:
        return {}
    folders = [str(path) for path in env.root.glob("lib/python*/site-packages")]
    found = {part.name: part.version for part in distributions(path=folders)}
    return {"lerobot_versions": {n: found[n] for n in PARTS if n in found}}
