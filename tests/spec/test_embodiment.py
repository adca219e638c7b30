from __future__ import annotations

import dataclasses
import json

import pytest

from fluxvla_core.errors import SpecMismatch
from fluxvla_core.spec import Camera, EmbodimentSpec, Joint, check_match

ELBOW = Joint("elbow", "rad", -1.5, 1.5, 2.0, 8.0)
GRIPPER = Joint("gripper", "normalized", 0.0, 1.0, 4.0, 40.0, "gripper", open=1.0, closed=0.0)
ARM = EmbodimentSpec("arm", (ELBOW, GRIPPER), (Camera("front", 48, 64),), rate_hz=50.0)


def test_json_round_trip_keeps_everything():
    again = EmbodimentSpec.from_dict(json.loads(json.dumps(ARM.to_dict())))
    assert again == ARM
    moved = dataclasses.replace(ARM, state_joints=(ELBOW,))
    again = EmbodimentSpec.from_dict(json.loads(json.dumps(moved.to_dict())))
    assert (again.dim, again.state_dim) == (2, 1)


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
        ({"kind": "hinge"}, "kind 'hinge' is none of"),
        ({"unit": "deg"}, "unit 'deg' is none of"),
    ],
)
def test_a_joint_refuses_limits_that_cannot_be(values, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(ELBOW, **values)


def test_names_are_unique():
    with pytest.raises(ValueError, match="joint names must be unique; twice: elbow"):
        dataclasses.replace(ARM, joints=(ELBOW, ELBOW))


@pytest.mark.parametrize("key", ["rate", "joint"])
def test_unknown_keys_are_refused(key):
    data = {**ARM.to_dict(), key: 1}
    with pytest.raises(SpecMismatch, match=f"EmbodimentSpec takes no '{key}'"):
        EmbodimentSpec.from_dict(data)
