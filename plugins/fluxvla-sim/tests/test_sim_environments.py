"""The simulated robots' environments do what every environment must."""

from __future__ import annotations

import numpy as np
import pytest
from fluxvla_sim.environment import AlohaSimEnvironment

from fluxvla_core.evaluation import Diverged
from fluxvla_core.evaluation.rollout import check_step
from fluxvla_core.testing import EnvironmentConformance

pytest.importorskip("mujoco")


class TestAlohaSimEnvironment(EnvironmentConformance):
    entry_point = "AlohaSimEnvironment"
    tasks = ("lift_hold", "insertion")


class TestURSimEnvironment(EnvironmentConformance):
    entry_point = "URSimEnvironment"


def test_controls_that_are_not_finite_are_noticed(tmp_path, monkeypatch):
    """MuJoCo drops all controls then; state and reward look as if the arms had been let go."""
    monkeypatch.chdir(tmp_path)  # where MuJoCo leaves its log
    environment = AlohaSimEnvironment()
    environment.reset(1, "lift_hold")
    environment.step(np.full(14, np.nan))
    with pytest.raises(Diverged, match="MuJoCo warned of BADCTRL"):
        check_step(environment, 1)
    environment.reset(1, "lift_hold")
    check_step(environment, 0)
    environment.close()
