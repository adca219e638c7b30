"""The tests that need LeRobot, in an environment that has it beside this project.

LeRobot 0.4.4 runs on every Python of this project. ``nox -s oracles`` runs the same with 0.6.1.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tools import oracle_env, shell
from tools.envs import Env, join

TESTS = Path(__file__).parent / "with_lerobot"
ROOT = TESTS.parents[3]


@pytest.mark.early
def test_with_lerobot_044():
    try:
        lerobot = oracle_env.prepare_044(print)
    except (shell.StepFailed, OSError) as error:
        pytest.skip(f"LeRobot cannot be installed here: {str(error).strip().splitlines()[-1]}")
    joined = join(lerobot, Env(Path(sys.prefix)))
    own = {key: value for key, value in os.environ.items() if not key.startswith("PYTEST")}
    done = subprocess.run(
        [joined.python, "-m", "pytest", "-q", "-p", "no:cacheprovider", TESTS],
        cwd=ROOT,
        env={**own, **joined.variables()},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    found = re.search(r"(\d+) passed", done.stdout)
    assert found is not None, done.stdout
    assert int(found[1]) > 35, done.stdout
