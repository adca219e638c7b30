"""ALOHA's numbers: order, polarity, and the limits against the simulator's own model."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from importlib import util
from pathlib import Path

import pytest
from fluxvla_aloha.embodiment import ARM_RANGES, GRIPPERS, START_POSE, aloha_spec

from fluxvla_core.spec.embodiment import Camera, EmbodimentSpec


def test_fourteen_joints_left_before_right():
    names = aloha_spec().joint_names

    assert len(names) == 14
    assert names[:7] == (
        "left_waist",
        "left_shoulder",
        "left_elbow",
        "left_forearm_roll",
        "left_wrist_angle",
        "left_wrist_rotate",
        "left_gripper",
    )
    assert names[7:] == tuple(n.replace("left", "right") for n in names[:7])


def test_grippers_say_which_end_is_open():
    joints = aloha_spec().joints
    grippers = [joints[i] for i in GRIPPERS]

    assert [g.kind for g in grippers] == ["gripper", "gripper"]
    assert [(g.closed, g.open, g.unit) for g in grippers] == [(0.0, 1.0, "normalized")] * 2
    assert {j.kind for i, j in enumerate(joints) if i not in GRIPPERS} == {"revolute"}


def test_the_start_pose_is_within_limits():
    for joint, value in zip(aloha_spec().joints, START_POSE, strict=True):
        assert joint.lower <= value <= joint.upper, joint.name


def test_cameras_and_rate_can_be_given():
    spec = aloha_spec(cameras=[Camera("top", 144, 192)], rate_hz=25)

    assert spec.camera_names == ("top",)
    assert spec.rate_hz == 25
    assert EmbodimentSpec.from_dict(spec.to_dict()) == spec


def test_an_arm_at_full_speed_stops_within_the_time_that_the_module_states():
    waist = aloha_spec().joints[0]

    assert waist.velocity / waist.acceleration == pytest.approx(0.157, abs=0.001)


@pytest.mark.skipif(util.find_spec("gym_aloha") is None, reason="gym-aloha is not installed")
def test_ranges_are_those_of_the_simulated_arm():
    place = Path(util.find_spec("gym_aloha").origin).parent / "assets" / "vx300s_left.xml"
    ranges = {
        joint.get("name").partition("/")[2]: [float(x) for x in joint.get("range").split()]
        for joint in ElementTree.parse(place).iter("joint")
        if joint.get("range")
    }

    for name, (lower, upper) in ARM_RANGES.items():
        assert ranges[name] == pytest.approx([lower, upper], abs=1e-4), name
    assert math.isclose(ARM_RANGES["waist"][1], math.pi, abs_tol=1e-4)
