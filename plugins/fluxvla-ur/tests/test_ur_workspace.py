"""The box of a UR arm; its kinematics are held against MuJoCo's in fluxvla-sim."""

from __future__ import annotations

import numpy as np
import pytest
from fluxvla_ur.embodiment import ur_spec
from fluxvla_ur.workspace import LENGTHS, URWorkspaceBox

from fluxvla_core import build_action_filter_from_cfg
from fluxvla_core.errors import ConfigError

HOME = np.array([-np.pi / 2, -np.pi / 2, np.pi / 2, -np.pi / 2, -np.pi / 2, 0.0, 1.0])
BOX = {"lower": (-0.4, 0.2, 0.05), "upper": (0.4, 0.8, 0.6)}
TOOL = (0.0, 0.0, 0.163)


@pytest.mark.parametrize("model", LENGTHS)
def test_a_stretched_arm_points_away_from_its_base(model):
    """All joints at zero: along -x, at the height of the shoulder less the wrist's offset."""
    d1, a2, a3, d4, d5, d6 = LENGTHS[model]
    box = URWorkspaceBox((-9, -9, -9), (9, 9, 9), (0, 0, 0), model)

    np.testing.assert_allclose(
        box.chain.position(np.zeros(6)), [a2 + a3, -d4 - d6, d1 - d5], atol=1e-12
    )


def test_a_config_builds_it_and_a_target_through_the_table_stays_above_it():
    table = {"type": "URWorkspaceBox", "model": "ur5e", "tool": TOOL, **BOX}
    box = build_action_filter_from_cfg(table)
    box.bind(ur_spec("ur5e"))
    start = box.chain.position(HOME[:6])
    assert (np.array(BOX["lower"]) < start).all()
    assert (start < np.array(BOX["upper"])).all()
    box.reset(HOME)
    lower = HOME.copy()
    for _ in range(40):
        lower = lower + [0, 0.02, 0.01, 0, 0, 0, 0]
        point = box.chain.position(box(lower)[:6])
        assert point[2] >= BOX["lower"][2]
    assert box.chain.position(lower[:6])[2] < BOX["lower"][2] - 0.1, "it was wanted there"


def test_a_model_that_is_not_there_is_refused():
    with pytest.raises(ConfigError, match="unknown UR model 'ur7'; known are ur3e, ur5e, ur10e"):
        URWorkspaceBox(*BOX.values(), TOOL, model="ur7")


def test_an_arm_of_another_make_is_refused():
    from fluxvla_core.operators import EmbodimentSpec, Joint

    box = URWorkspaceBox(*BOX.values(), TOOL)
    other = EmbodimentSpec("other", (Joint("elbow", "rad", -1, 1, 1, 1),), (), 50.0)
    with pytest.raises(ConfigError, match="there is no joint 'shoulder_pan_joint'"):
        box.bind(other)
