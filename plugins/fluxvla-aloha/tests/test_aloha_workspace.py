"""The box of one ViperX arm; its kinematics are held against MuJoCo's in fluxvla-sim."""

from __future__ import annotations

import numpy as np
import pytest
from fluxvla_aloha.embodiment import aloha_spec, start_pose
from fluxvla_aloha.workspace import AlohaWorkspaceBox

from fluxvla_core import build_action_filter_from_cfg
from fluxvla_core.errors import ConfigError

BOX = {"lower": (0.05, -0.4, 0.03), "upper": (0.6, 0.4, 0.6)}


def test_at_zero_the_arm_is_stretched_forward():
    box = AlohaWorkspaceBox("left", (-9, -9, -9), (9, 9, 9))

    np.testing.assert_allclose(
        box.chain.position(np.zeros(6)),
        [0.05955 + 0.2 + 0.1 + 0.069744 + 0.15, 0, 0.079 + 0.04805 + 0.3],
        atol=1e-12,
    )


@pytest.mark.parametrize(("arm", "first"), [("left", 0), ("right", 7)])
def test_a_config_builds_one_for_each_arm_and_the_other_arm_is_left_alone(arm, first):
    box = build_action_filter_from_cfg({"type": "AlohaWorkspaceBox", "arm": arm, **BOX})
    box.bind(aloha_spec())
    pose = np.array(start_pose("viperx300"))
    box.reset(pose)
    down = pose.copy()
    down[[1, 8]] += 1.0

    given = box(down)

    assert box.chain.position(given[first : first + 6])[2] >= BOX["lower"][2]
    assert box.chain.position(down[first : first + 6])[2] < BOX["lower"][2]
    others = [column for column in range(14) if not first <= column < first + 6]
    np.testing.assert_array_equal(given[others], down[others])


@pytest.mark.parametrize("arms", ["arx_x5", "piper"])
def test_another_kind_of_arm_is_refused(arms):
    box = AlohaWorkspaceBox("left", *BOX.values())

    with pytest.raises(ConfigError, match="left_waist"):
        box.bind(aloha_spec(arms=arms))


def test_an_arm_that_is_not_there_is_refused():
    with pytest.raises(ConfigError, match="arm is 'left' or 'right', got 'middle'"):
        AlohaWorkspaceBox("middle", *BOX.values())
