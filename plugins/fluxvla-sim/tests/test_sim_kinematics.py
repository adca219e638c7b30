"""The arms' kinematics, as their workspace boxes have them, held against MuJoCo's."""

from __future__ import annotations

import numpy as np
import pytest
from fluxvla_aloha.workspace import AlohaWorkspaceBox
from fluxvla_sim.aloha.cube import AlohaScene
from fluxvla_sim.ur import URScene
from fluxvla_ur.embodiment import JOINTS
from fluxvla_ur.workspace import URWorkspaceBox

mujoco = pytest.importorskip("mujoco")
EVERYWHERE = ((-9, -9, -9), (9, 9, 9))


def poses(count, dim):
    return np.random.default_rng(0).uniform(-1.5, 1.5, (count, dim))


def in_frame(data, body, point):
    """``point`` of the world, in the frame of ``body``."""
    return data.body(body).xmat.reshape(3, 3).T @ (point - data.body(body).xpos)


@pytest.mark.parametrize("arm", ["left", "right"])
def test_a_viper_x(arm):
    model = AlohaScene().model
    data = mujoco.MjData(model)
    box = AlohaWorkspaceBox(arm, *EVERYWHERE)
    names = [name.removeprefix(f"{arm}_") for name in box.joints]
    places = [model.joint(f"vx300s_{arm}/{name}").qposadr[0] for name in names]
    for pose in poses(20, 6):
        data.qpos[places] = pose
        mujoco.mj_kinematics(model, data)
        there = in_frame(data, f"vx300s_{arm}", data.site(f"cali_{arm}_site1").xpos)
        np.testing.assert_allclose(box.chain.position(pose), there, atol=1e-6)


def test_a_ur5e():
    """The Menagerie rounds the lengths; its world is the pendant's Base."""
    model = URScene().model
    data = mujoco.MjData(model)
    box = URWorkspaceBox(*EVERYWHERE, tool=(0, 0, 0), model="ur5e")
    places = [model.joint(name).qposadr[0] for name in JOINTS]
    for pose in poses(20, 6):
        data.qpos[places] = pose
        mujoco.mj_kinematics(model, data)
        there = data.site("attachment_site").xpos
        np.testing.assert_allclose(box.chain.position(pose), there, atol=2e-3)
