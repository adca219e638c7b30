"""Joint states by name."""

from __future__ import annotations

import array
import math
from types import SimpleNamespace

import numpy as np
import pytest

from fluxvla_core.ros2 import BadMessage, joints


def message(names, values):
    return SimpleNamespace(name=list(names), position=array.array("d", values))


def test_order_follows_the_names_asked_for():
    got = joints.positions(message("cab", [3.0, 1.0, 2.0]), ("a", "b", "c"))

    np.testing.assert_array_equal(got, [1.0, 2.0, 3.0])
    assert got.dtype == np.float64


def test_joints_that_nobody_asked_for_are_passed_over():
    np.testing.assert_array_equal(joints.positions(message("xay", [9, 1, 9]), ("a",)), [1.0])


@pytest.mark.parametrize(
    ("sent", "what"),
    [
        (message("ab", [1, 2]), "arm: no joint called c; there are a, b"),
        (message("", [1, 2, 3]), "arm: 3 positions without joint names"),
        (message("abc", [1, 2]), "arm: 3 joint names, but 2 positions"),
        (message("abca", [1, 2, 3, 4]), "arm: joint names come twice: a"),
        (message("abc", [1, math.nan, math.inf]), "arm: the position of b, c is not a finite"),
    ],
)
def test_what_cannot_be_a_state_is_named(sent, what):
    with pytest.raises(BadMessage) as caught:
        joints.positions(sent, ("a", "b", "c"), "arm")

    assert caught.value.what.startswith(what)


def test_filling_takes_plain_lists():
    filled = joints.fill(SimpleNamespace(), ("a", "b"), np.array([1, 2], np.float32))

    assert filled.name == ["a", "b"]
    assert filled.position == [1.0, 2.0]
    assert all(type(value) is float for value in filled.position)
