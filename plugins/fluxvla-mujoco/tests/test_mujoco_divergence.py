"""Environments on MuJoCo notice a simulation that diverged, whatever they inherit."""

from __future__ import annotations

import numpy as np
import pytest
from fluxvla_mujoco import divergence

from fluxvla_core.evaluation import Environment, EnvironmentSpec, Step, TaskSpec
from fluxvla_core.operators import EmbodimentSpec, Joint
from fluxvla_core.testing import EnvironmentConformance

mujoco = pytest.importorskip("mujoco")

MODEL = """
<mujoco><worldbody><body>
  <joint name="x" type="slide" axis="1 0 0"/><geom size="0.1" mass="1"/>
</body></worldbody></mujoco>
"""


class Unwatched:
    """A body on a rail; inherits nothing and has no ``divergence()``."""

    def __init__(self):
        joint = Joint("x", "m", -1.0, 1.0, 1.0, 10.0, "prismatic")
        embodiment = EmbodimentSpec("rail", (joint,), (), rate_hz=10.0, action_mode="delta")
        self.spec = EnvironmentSpec("a rail", embodiment, (TaskSpec("right", "go right", 40),))
        self.model = mujoco.MjModel.from_xml_string(MODEL)
        self.simulation = mujoco.MjData(self.model)

    def reset(self, seed, task):
        mujoco.mj_resetData(self.model, self.simulation)
        self.simulation.qpos[0] = np.random.default_rng(seed).uniform(-0.1, 0.1)

    def step(self, action):
        self.simulation.qvel[0] += action[0]
        mujoco.mj_step(self.model, self.simulation)
        return Step(0.0, False, False)

    @property
    def state(self):
        return self.simulation.qpos.copy()

    def observe(self, cameras):
        qpos = self.state.astype(np.float32)
        return {"qpos": qpos, "images": {}, "task_description": "go right"}

    def close(self):
        return


class Watched(Unwatched):
    """The same with the helper."""

    def divergence(self):
        return divergence(self.simulation)


class TestWatched(EnvironmentConformance):
    def make(self):
        return Environment.adapt(Watched())


def test_the_conformance_kit_says_what_is_missing(tmp_path, monkeypatch):
    kit = TestWatched()
    check = kit.test_a_simulation_that_diverges_is_an_error_and_no_outcome
    with pytest.raises(AssertionError, match=r"return fluxvla_mujoco\.divergence\(data\)"):
        check(Environment.adapt(Unwatched()), tmp_path, monkeypatch)


def test_there_is_nothing_to_say_without_a_simulation():
    assert divergence(None) is None
