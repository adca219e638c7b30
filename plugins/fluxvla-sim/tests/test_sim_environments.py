"""The simulated robots' environments do what every environment must."""

from __future__ import annotations

import pytest

from fluxvla_core.testing import EnvironmentConformance

pytest.importorskip("mujoco")


class TestAlohaSimEnvironment(EnvironmentConformance):
    entry_point = "AlohaSimEnvironment"
    tasks = ("lift_hold", "insertion")


class TestURSimEnvironment(EnvironmentConformance):
    entry_point = "URSimEnvironment"
