"""ALOHA's numbers: order, polarity, limits of each kind of arms, and the simulator's own model."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from importlib import util
from pathlib import Path

import pytest
from fluxvla_aloha.arms import ARMS, VIPERX300
from fluxvla_aloha.embodiment import GRIPPERS, aloha_spec, start_pose

from fluxvla_core.errors import ConfigError, SpecMismatch
from fluxvla_core.operators import Camera, EmbodimentSpec
from fluxvla_core.spec import check_match


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


@pytest.mark.parametrize("arms", ARMS)
def test_grippers_say_which_end_is_open(arms):
    joints = aloha_spec(arms=arms).joints
    grippers = [joints[i] for i in GRIPPERS]

    assert [g.kind for g in grippers] == ["gripper", "gripper"]
    assert [(g.closed, g.open, g.unit) for g in grippers] == [(0.0, 1.0, "normalized")] * 2
    assert {j.kind for i, j in enumerate(joints) if i not in GRIPPERS} == {"revolute"}


@pytest.mark.parametrize("arms", ARMS)
def test_the_start_pose_is_within_limits(arms):
    for joint, value in zip(aloha_spec(arms=arms).joints, start_pose(arms), strict=True):
        assert joint.lower <= value <= joint.upper, joint.name


@pytest.mark.parametrize(
    ("arms", "shoulder", "elbow", "wrist", "speed", "acceleration"),
    [
        ("arx_x5", (0.0, 3.14), (0.0, 3.14), (-1.57, 1.57), 5.0, 5.0),
        ("piper", (0.0, 3.14), (-2.967, 0.0), (-1.22, 1.22), 3.0, 5.0),
    ],
)
def test_limits_are_those_of_the_sources(arms, shoulder, elbow, wrist, speed, acceleration):
    for side in (0, 7):
        _, second, third, _, fifth, _, _ = aloha_spec(arms=arms).joints[side : side + 7]
        found = [(joint.lower, joint.upper) for joint in (second, third, fifth)]
        assert found == [shoulder, elbow, wrist]
        assert (second.velocity, second.acceleration) == (speed, acceleration)


@pytest.mark.parametrize(
    ("one", "other"), [("viperx300", "arx_x5"), ("arx_x5", "piper"), ("piper", "viperx300")]
)
def test_a_policy_for_other_arms_does_not_fit(one, other):
    with pytest.raises(SpecMismatch, match="joints and their order"):
        check_match(aloha_spec(arms=one), aloha_spec(arms=other), "policy", "robot")


def test_unknown_arms_are_refused_with_the_known_ones():
    with pytest.raises(ConfigError, match="unknown arms 'x5'; known are viperx300, arx_x5, piper"):
        aloha_spec(arms="x5")


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

    for joint in VIPERX300.joints[:-1]:
        assert ranges[joint.name] == pytest.approx([joint.lower, joint.upper], abs=1e-4), joint.name
    assert math.isclose(VIPERX300.joints[0].upper, math.pi, abs_tol=1e-4)
