"""Wheels, and an environment that holds the core's wheel and what it declares, nothing else."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tools import project, wheels
from tools.envs import Env


@pytest.fixture(scope="module")
def core_alone(tmp_path_factory: pytest.TempPathFactory) -> Env:
    folder = tmp_path_factory.mktemp("core")
    core = project.distributions()[0]
    made = wheels.build([core], folder / "dist", Env(Path(sys.prefix)))
    env = Env(folder / "env")
    env.create()
    env.pip_install(made[core.name], constraints=project.CONSTRAINTS)
    return env
