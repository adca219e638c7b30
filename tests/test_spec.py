from __future__ import annotations

import dataclasses
import json

import pytest

from fluxvla_core import Camera, EmbodimentSpec, Joint
from fluxvla_core.errors import SpecMismatch
from fluxvla_core.spec import check_match, speeds

ELBOW = Joint("elbow", "rad", -1.5, 1.5, 2.0, 8.0)
GRIPPER = Joint("gripper", "normalized", 0.0, 1.0, 4.0, 40.0, "gripper", open=1.0, closed=0.0)
ARM = EmbodimentSpec("arm", (ELBOW, GRIPPER), (Camera("front", 48, 64),), rate_hz=50.0)


def test_json_round_trip_keeps_everything():
    again = EmbodimentSpec.from_dict(json.loads(json.dumps(ARM.to_dict())))
    assert again == ARM
    moved = dataclasses.replace(ARM, state_joints=(ELBOW,))
    again = EmbodimentSpec.from_dict(json.loads(json.dumps(moved.to_dict())))
    assert (again.dim, again.state_dim) == (2, 1)


def test_a_jerk_limit_is_kept_and_one_that_is_not_there_is_not_written():
    """So that descriptions from before it, and readers from before it, are understood."""
    limited = dataclasses.replace(ARM, joints=(dataclasses.replace(ELBOW, jerk=200.0), GRIPPER))
    table = json.loads(json.dumps(limited.to_dict()))

    assert [joint.get("jerk", "none") for joint in table["joints"]] == [200.0, "none"]
    assert EmbodimentSpec.from_dict(table) == limited
    check_match(ARM, limited, "policy", "robot")
    with_states = dataclasses.replace(ARM, state_joints=(ELBOW,)).to_dict()
    assert "jerk" not in json.dumps(with_states)


def test_equal_specs_match_and_limits_or_sizes_may_differ():
    other = dataclasses.replace(
        ARM,
        joints=(dataclasses.replace(ELBOW, velocity=1.0), GRIPPER),
        cameras=(Camera("front", 480, 640), Camera("extra", 1, 1)),
    )
    check_match(ARM, other, "policy", "robot")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"joints": (GRIPPER, ELBOW)}, "joints and their order"),
        ({"joints": (dataclasses.replace(ELBOW, unit="m"), GRIPPER)}, "unit of elbow: rad / m"),
        (
            {"joints": (ELBOW, dataclasses.replace(GRIPPER, open=0.0, closed=1.0))},
            "open/closed of gripper gripper: (1.0, 0.0) / (0.0, 1.0)",
        ),
        ({"action_mode": "delta"}, "action mode: absolute / delta"),
        ({"rotation": "quaternion_xyzw"}, "rotation: none / quaternion_xyzw"),
        ({"cameras": ()}, "cameras: front missing"),
    ],
)
def test_each_difference_in_meaning_is_an_error_that_names_it(change, message):
    with pytest.raises(SpecMismatch) as error:
        check_match(ARM, dataclasses.replace(ARM, **change), "policy", "robot")
    assert message in str(error.value)
    assert "policy (arm) and robot (arm) do not fit together" in str(error.value)


def test_all_differences_are_named_at_once():
    other = dataclasses.replace(ARM, action_mode="delta", cameras=())
    with pytest.raises(SpecMismatch) as error:
        check_match(ARM, other, "policy", "robot")
    assert "action mode" in str(error.value)
    assert "cameras" in str(error.value)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"lower": 2.0}, "lower 2.0 is not below 1.5"),
        ({"velocity": 0.0}, "velocity and acceleration must be positive"),
        ({"upper": float("inf")}, "limits must be finite"),
        ({"kind": "gripper"}, "open and closed state its polarity"),
        ({"kind": "hinge"}, "kind 'hinge' is not one of"),
        ({"unit": "deg"}, "unit 'deg' is not one of"),
        ({"unit": "m/s"}, "joint elbow: unit 'm/s' is a speed's; a mobile base, or another joint"),
        ({"unit": "rad/s"}, "unit 'rad/s' is a speed's"),
        ({"unit": "rpm"}, "unit 'rpm' is a speed's"),
        ({"kind": "wheel"}, "kind 'wheel' is a speed's; a mobile base, .* has kind 'velocity'"),
        ({"kind": "base"}, "kind 'base' is a speed's"),
        ({"open": float("nan")}, "open and closed must be finite"),
        ({"jerk": 0.0}, "jerk must be positive, got 0"),
        ({"jerk": float("nan")}, "jerk must be positive, got nan"),
    ],
)
def test_a_joint_refuses_limits_that_cannot_be(values, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(ELBOW, **values)


@pytest.mark.parametrize(
    ("name", "speed"),
    [
        *((name, True) for name in ("base_linear", "base_angular", "x.vel", "linear_x", "vx")),
        *((name, True) for name in ("baseForward", "left_wheel", "angular.z", "cmd_vel_x", "vyaw")),
        # The first joint of a UR, of hobby arms; a linear axis, a base's pose, a rotation vector.
        *((name, False) for name in ("base", "base_rotation", "linear_axis", "base_x", "ee.wx")),
        *((name, False) for name in ("left_waist", "shoulder_pan_joint", "wheelchair_arm_1")),
    ],
)
def test_which_joints_are_speeds_by_their_names(name, speed):
    arm = dataclasses.replace(ARM, joints=(dataclasses.replace(ELBOW, name=name), GRIPPER))

    assert speeds(arm) == ([name] if speed else [])


@pytest.mark.parametrize(("height", "width"), [(0, 64), (48, -1), (48.0, 64), ("48", 64)])
def test_a_camera_has_pixels(height, width):
    with pytest.raises(ValueError, match="camera front: height and width are whole numbers"):
        Camera("front", height, width)


def test_names_are_unique():
    with pytest.raises(ValueError, match="joint names must be unique; twice: elbow"):
        dataclasses.replace(ARM, joints=(ELBOW, ELBOW))


@pytest.mark.parametrize("key", ["rate", "joint"])
def test_unknown_keys_are_refused(key):
    data = {**ARM.to_dict(), key: 1}
    with pytest.raises(SpecMismatch, match=f"EmbodimentSpec takes no '{key}'"):
        EmbodimentSpec.from_dict(data)


@pytest.mark.parametrize(
    ("changes", "fact"),
    [
        ({"joints": 3}, "joints: "),
        ({"joints": [3]}, "joints.0: "),
        ({"name": 5}, "name: "),
        ({"rate_hz": "50"}, "rate_hz: "),
        ({"cameras": [{"name": "top", "height": "480", "width": 640}]}, "cameras.0.height: "),
        ({"cameras": [{"name": "top", "height": 480, "width": 10**9}]}, "from 1 to 16384"),
        ({"cameras": [{"name": "top", "height": 480, "width": 640, "x": 1}]}, "takes no 'x'"),
    ],
)
def test_wrong_types_are_named_by_their_field(changes, fact):
    joint = Joint("j", "rad", -1.0, 1.0, 1.0, 1.0)
    data = {**EmbodimentSpec("arm", (joint,), (), 10.0).to_dict(), **changes}
    with pytest.raises(SpecMismatch) as caught:
        EmbodimentSpec.from_dict(data)
    assert str(caught.value).startswith("this is not an embodiment spec: ")
    assert fact in str(caught.value)
