"""Actions before any I/O."""

from __future__ import annotations

import numpy as np
import pytest

from fluxvla_core.errors import Rejected
from fluxvla_core.ros2 import checked_action
from fluxvla_core.spec import EmbodimentSpec, Joint

SPEC = EmbodimentSpec(
    "arm",
    (
        Joint("elbow", "rad", -1.0, 1.0, 1.0, 1.0),
        Joint("wrist", "rad", -2.0, 2.0, 1.0, 1.0),
        Joint("grip", "normalized", 0.0, 1.0, 1.0, 1.0, kind="gripper", open=1.0, closed=0.0),
    ),
    (),
    50.0,
)


def test_a_good_action_is_copied():
    action = np.array([0.1, 0.2, 0.3])
    checked = checked_action(SPEC, action)

    np.testing.assert_array_equal(checked, action)
    assert not np.shares_memory(checked, action)
    assert checked_action(SPEC, [1, 2, 1]).dtype == np.float64


@pytest.mark.parametrize(
    ("action", "what"),
    [
        ([0.0, 0.0], r"arm takes actions of shape \(3,\), got \(2,\)"),
        ([[0.0, 0.0, 0.0]], r"got \(1, 3\)"),
        ([0.0, np.nan, 0.0], "wrist: the command is nan, not a finite number"),
        ([np.inf, 0.0, 0.0], "elbow: the command is inf"),
        ([1.001, 0.0, 0.0], r"elbow: the command 1.001 rad is outside \[-1, 1\]"),
        ([0.0, 0.0, -0.5], r"grip: the command -0.5 normalized is outside \[0, 1\]"),
    ],
)
def test_a_bad_action_is_refused_and_named(action, what):
    with pytest.raises(Rejected, match=what):
        checked_action(SPEC, action)
