"""Forward kinematics against closed forms; plugins hold it against MuJoCo's."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fluxvla_core.control.kinematics import Chain, Link
from fluxvla_core.errors import ConfigError

PLANAR = Chain([Link(), Link(xyz=(0.5, 0, 0))], tool=(0.25, 0, 0))
UR5E_LIKE = [
    (0, 0.16, np.pi / 2),
    (-0.4, 0, 0),
    (-0.4, 0, 0),
    (0, 0.13, np.pi / 2),
    (0, 0.1, -np.pi / 2),
    (0, 0.1, 0),
]
angles = st.floats(-3.0, 3.0)


@given(a=angles, b=angles)
@settings(max_examples=25, deadline=None)
def test_a_planar_arm_is_what_trigonometry_says(a, b):
    expected = [
        0.5 * np.cos(a) + 0.25 * np.cos(a + b),
        0.5 * np.sin(a) + 0.25 * np.sin(a + b),
        0.0,
    ]
    np.testing.assert_allclose(PLANAR.position([a, b]), expected, atol=1e-12)


def dh_matrix(theta, a, d, alpha):
    """One row of the original convention, as text books print the product."""
    ct, st_, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    return np.array(
        [
            [ct, -st_ * ca, st_ * sa, a * ct],
            [st_, ct * ca, -ct * sa, a * st_],
            [0, sa, ca, d],
            [0, 0, 0, 1],
        ]
    )


@given(q=st.lists(angles, min_size=6, max_size=6))
@settings(max_examples=25, deadline=None)
def test_denavit_hartenberg_rows_are_the_text_books_product(q):
    tool = (0.01, -0.02, 0.15)
    whole = np.eye(4)
    for theta, row in zip(q, UR5E_LIKE, strict=True):
        whole = whole @ dh_matrix(theta, *row)

    found = Chain.of_dh(UR5E_LIKE, tool).position(q)
    np.testing.assert_allclose(found, (whole @ [*tool, 1.0])[:3], atol=1e-12)


@given(q=st.lists(angles, min_size=6, max_size=6))
@settings(max_examples=25, deadline=None)
def test_the_jacobian_is_the_derivative(q):
    chain = Chain.of_dh(UR5E_LIKE, (0, 0, 0.1))
    _, jacobian = chain.position_and_jacobian(q)
    for column in range(6):
        step = np.zeros(6)
        step[column] = 1e-6
        slope = (chain.position(np.add(q, step)) - chain.position(np.subtract(q, step))) / 2e-6
        np.testing.assert_allclose(jacobian[:, column], slope, atol=1e-8)


def test_frames_are_turned_as_urdf_turns_them():
    # Fixed axes: roll about x first, then pitch about y, then yaw about z.
    chain = Chain([{"xyz": (1, 2, 3), "rpy": (np.pi / 2, 0, np.pi / 2)}], tool=(0, 1, 0))

    np.testing.assert_allclose(chain.position([0.0]), [1, 2, 4], atol=1e-12)


def test_an_axis_need_not_have_length_one():
    chain = Chain([Link(axis=(0, 0, -2))], tool=(1, 0, 0))

    np.testing.assert_allclose(chain.position([np.pi / 2]), [0, -1, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("links", "message"),
    [
        ([], "a chain needs at least one link"),
        ([{"xyz": (1, 2)}], "xyz must be three numbers, got (1, 2)"),
        ([{"rpy": "a b c"}], "rpy must be three numbers, got 'a b c'"),
        ([{"axis": (0, 0, 0)}], "an axis of a chain has no length"),
        ([{"xyz": (0, 0, float("nan"))}], "xyz must be three numbers"),
        ([{"xzy": (0, 0, 0)}], "a link has xyz, rpy and axis, got {'xzy': (0, 0, 0)}"),
    ],
)
def test_what_is_no_chain_is_refused(links, message):
    with pytest.raises(ConfigError) as caught:
        Chain(links)
    assert message in str(caught.value)


def test_dh_rows_are_three_numbers():
    with pytest.raises(ConfigError, match=r"dh must be three numbers, got \(1, 2\)"):
        Chain.of_dh([(1, 2)])
