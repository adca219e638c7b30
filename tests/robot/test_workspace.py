"""A box that the arm's point does not leave, whatever is wanted; and the limits still hold."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fluxvla_core.control.filters import WorkspaceBox
from fluxvla_core.control.kinematics import Chain
from fluxvla_core.control.limits import CommandLimiter
from fluxvla_core.errors import ConfigError, SafetyStop
from fluxvla_core.spec import EmbodimentSpec, Joint

NAMES = ("pan", "lift", "elbow")
# A vertical shoulder, then two pitching links: 0.3 m and 0.3 m from a base 0.2 m high.
LINKS = [
    {"xyz": (0, 0, 0.2)},
    {"axis": (0, 1, 0)},
    {"xyz": (0.3, 0, 0), "axis": (0, 1, 0)},
]
TOOL = (0.3, 0, 0)
ARM = EmbodimentSpec(
    "arm",
    (
        Joint("grip", "normalized", 0, 1, 2, 20, kind="gripper", open=1.0, closed=0.0),
        *(Joint(name, "rad", -2.0, 2.0, 2.0, 10.0) for name in NAMES),
    ),
    (),
    50.0,
)
LOWER, UPPER = (0.1, -0.3, 0.05), (0.5, 0.3, 0.6)
START = np.array([0.5, 0.0, -0.6, 1.2])  # the point is at (0.495, 0, 0.2)
CHAIN = Chain(LINKS, TOOL)
RANGES = np.array([(j.lower, j.upper) for j in ARM.joints]).T


def box(**changes):
    made = WorkspaceBox(LOWER, UPPER, NAMES, **{"links": LINKS, "tool": TOOL, **changes})
    made.bind(ARM)
    made.reset(START)
    return made


def inside(action, slack=0.0):
    point = CHAIN.position(action[1:])
    return bool(
        (np.subtract(LOWER, slack) <= point).all() and (point <= np.add(UPPER, slack)).all()
    )


def test_what_is_inside_passes_unchanged():
    np.testing.assert_array_equal(box()(START), START)


def test_a_target_below_the_floor_goes_to_the_floor_and_no_further():
    wanted = START + [0.2, 0.0, 0.5, 0.0]
    assert not inside(wanted)

    given_ = box()(wanted)

    assert inside(given_)
    assert CHAIN.position(given_[1:])[2] == pytest.approx(LOWER[2], abs=2e-6)
    assert given_[0] == wanted[0], "the gripper is not the box's"


def test_a_motion_along_a_wall_goes_on_along_it():
    """Wanting 5 cm below the floor while moving sideways: the sideways part is kept."""
    filter_, ways = box(), []
    for pan in np.linspace(-0.3, 0.3, 40):
        ways.append(CHAIN.position(filter_(START + [0, pan, 0.3, 0.1])[1:]))
    ways = np.array(ways)

    np.testing.assert_allclose(ways[:, 2], LOWER[2], atol=2e-6)
    assert np.ptp(ways[:, 1]) > 0.2
    assert (np.diff(ways[:, 1]) > 0).all()


def test_an_unreachable_first_target_is_refused_without_a_pose_to_stay_at():
    made = WorkspaceBox((5, 5, 5), (6, 6, 6), NAMES, links=LINKS, tool=TOOL)
    made.bind(ARM)

    with pytest.raises(SafetyStop, match="WorkspaceBox: the first target is outside the box"):
        made(START)


def test_an_unreachable_box_holds_the_arm():
    made = WorkspaceBox((5, 5, 5), (6, 6, 6), NAMES, links=LINKS, tool=TOOL)
    made.bind(ARM)
    made.reset(START)

    np.testing.assert_array_equal(made(START + 0.3)[1:], START[1:])


wild = st.lists(
    st.lists(st.floats(-4.0, 4.0), min_size=4, max_size=4).map(np.array), min_size=1, max_size=8
)


@settings(max_examples=60, deadline=None)
@given(targets=wild)
def test_whatever_is_wanted_the_targets_point_is_inside(targets):
    filter_ = box()
    for wanted in targets:
        # What is inside once the limits have clipped it passes as it is, and is clipped there.
        assert inside(np.clip(filter_(wanted), RANGES[0], RANGES[1]), slack=1e-12)


@settings(max_examples=12, deadline=None)
@given(targets=wild)
def test_after_the_box_the_limits_hold(targets):
    filter_, limiter = box(), CommandLimiter(ARM, 0.02)
    limiter.start(START)
    path = [START, START]
    for wanted in targets:
        for _ in range(12):
            path.append(limiter.step(filter_(wanted))[0])
    speed = np.diff(path, axis=0) / 0.02
    push = np.diff(speed, axis=0) / 0.02
    joints = ARM.joints
    assert (np.abs(speed) <= [j.velocity for j in joints]).all()
    assert (np.abs(push) <= [j.acceleration for j in joints]).all()


def test_a_smooth_motion_into_a_wall_stays_within_a_centimetre_of_the_box():
    """What a policy does: a motion through the floor and along it, at half the joints' speed."""
    filter_, limiter = box(), CommandLimiter(ARM, 0.02)
    limiter.start(START)
    worst = 0.0
    for tick in range(400):
        phase = tick * 0.02
        wanted = START + [
            0,
            0.4 * np.sin(2 * phase),
            0.4 * np.sin(1.5 * phase),
            0.3 * np.sin(phase),
        ]
        point = CHAIN.position(limiter.step(filter_(wanted))[0][1:])
        out = np.maximum(np.subtract(LOWER, point), np.subtract(point, UPPER))
        worst = max(worst, float(out.max()))
    assert worst < 0.01


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lower": (1, 1, 1)}, "WorkspaceBox: lower [1, 1, 1] is not below upper"),
        ({"lower": (1, 1)}, "lower must be three numbers, got (1, 1)"),
        ({"dh": [(0, 0, 0)]}, "WorkspaceBox: give links or dh, one of them"),
        ({"links": None}, "WorkspaceBox: give links or dh, one of them"),
        ({"joints": NAMES[:2]}, "WorkspaceBox: 2 joints are named, 3 described"),
        (
            {"joints": ("pan", "lift", "elbw")},
            "WorkspaceBox: there is no joint 'elbw'; did you mean 'elbow'?",
        ),
    ],
)
def test_what_is_no_box_is_refused(changes, message):
    arguments = {"lower": LOWER, "upper": UPPER, "joints": NAMES, "links": LINKS, **changes}
    with pytest.raises(ConfigError) as caught:
        WorkspaceBox(**arguments).bind(ARM)
    assert message in str(caught.value)


def test_dh_rows_do_as_well():
    made = WorkspaceBox((-2, -2, -2), (2, 2, 2), NAMES, dh=[(0.3, 0, 0)] * 3, tool=(0, 0, 0))

    np.testing.assert_allclose(made.chain.position([0, 0, 0]), [0.9, 0, 0])
