"""The arms' numbers: order, speeds by model, and what is refused."""

from __future__ import annotations

from math import radians

import pytest
from fluxvla_ur.embodiment import GRIPPERS, JOINTS, SPEEDS, ur_spec

from fluxvla_core.errors import ConfigError
from fluxvla_core.operators import Camera, EmbodimentSpec


def test_the_drivers_joint_order_then_the_gripper():
    assert ur_spec().joint_names == (
        "shoulder_pan_joint",
        "shoulder_lift_joint",
        "elbow_joint",
        "wrist_1_joint",
        "wrist_2_joint",
        "wrist_3_joint",
        "gripper",
    )
    gripper = ur_spec().joints[GRIPPERS[0]]
    assert (gripper.kind, gripper.closed, gripper.open) == ("gripper", 0.0, 1.0)


@pytest.mark.parametrize(
    ("model", "base", "wrist"), [("ur3e", 180, 360), ("ur5e", 180, 180), ("ur10e", 120, 180)]
)
def test_speeds_are_the_models_own(model, base, wrist):
    spec = ur_spec(model)

    assert spec.name == model
    assert spec.joints[0].velocity == pytest.approx(radians(base))
    assert spec.joints[5].velocity == pytest.approx(radians(wrist))


@pytest.mark.parametrize("model", SPEEDS)
def test_every_joint_turns_once_each_way_but_the_elbow(model):
    for name, joint in zip(JOINTS, ur_spec(model).joints, strict=False):
        reach = 180 if name == "elbow_joint" else 360
        assert (joint.lower, joint.upper) == pytest.approx((-radians(reach), radians(reach)))


def test_cameras_and_rate_can_be_given():
    spec = ur_spec("ur5e", cameras=[Camera("front", 96, 96)], rate_hz=125)

    assert (spec.camera_names, spec.rate_hz) == (("front",), 125)
    assert EmbodimentSpec.from_dict(spec.to_dict()) == spec


def test_an_unknown_model_is_refused_with_the_known_ones():
    with pytest.raises(ConfigError, match="unknown UR model 'ur5'; known are ur3e, ur5e, ur10e"):
        ur_spec("ur5")
