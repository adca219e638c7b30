"""The kit of action filters: right ones pass, and each wrong one fails its own check in words."""

from __future__ import annotations

import pytest

from fluxvla_core.testing import ActionFilterConformance

from .specimens import Fault, Outcomes, check_fault, check_good, outcomes

GOOD = '''
import time
import numpy as np
from fluxvla_core import ACTION_FILTERS, ActionFilter
from fluxvla_core.errors import ConfigError
from fluxvla_core.testing import ActionFilterConformance

@ACTION_FILTERS.register_module()
class Specimen(ActionFilter):
    """Goes half of the way to each target."""
    api = "1.0"
    def __init__(self, joint: str = "joint_1"):
        self.joint = joint
    def bind(self, embodiment):
        if self.joint not in embodiment.joint_names:
            raise ConfigError(f"there is no joint {self.joint}")
        self.column = embodiment.joint_names.index(self.joint)
    def reset(self, pose):
        self.last = np.array(pose)
    def __call__(self, action):
        self.last = 0.5 * (self.last + action)
        return self.last.copy()

class TestSpecimen(ActionFilterConformance):
    entry_point = "Specimen"
'''
FAULTS = {
    "no version": Fault("is_complete", '    api = "1.0"\n', "", "the version of the contract"),
    "too few": Fault(
        "it_gives_a_target", "return self.last.copy()", "return self.last[:3].copy()",
        "gave the shape (3,), expected (7,)",
    ),
    "not finite": Fault(
        "it_gives_a_target", "return self.last.copy()", "return self.last.copy() * np.inf",
        "expected finite ones",
        ("an_episode_does_not_depend_on_earlier_ones", "another_object_does_the_same"),
    ),
    "in place": Fault(
        "the_action_belongs_to_the_caller", "self.last = 0.5 *", "action += 0.01; self.last = "
        "0.5 *",
        "changed the action",
    ),
    "lends": Fault(
        "what_it_gave_is_not_used_again", "return self.last.copy()", "return self.last",
        "expected a fresh array each time",
    ),
    "remembers": Fault(
        "an_episode_does_not_depend_on_earlier_ones", "self.last = np.array(pose)",
        'self.last = getattr(self, "last", np.array(pose))', "what it keeps begins anew",
        ("what_it_gave_is_not_used_again",),
    ),
    "each its own": Fault(
        "another_object_does_the_same",
        '    api = "1.0"\n    def __init__(self, joint: str = "joint_1"):\n'
        "        self.joint = joint\n",
        '    api = "1.0"\n    made = []\n    def __init__(self, joint: str = "joint_1"):\n'
        "        self.joint = joint\n        self.made.append(0.1)\n        self.bias = "
        "sum(self.made)\n"
        "    def __getattribute__(self, name):\n"
        "        found = object.__getattribute__(self, name)\n"
        '        return found + self.bias if name == "last" else found\n',
        "the process that commands the robot has one of its own",
    ),
    "a robot without words": Fault(
        "a_robot_that_does_not_fit_is_refused_in_words",
        "        if self.joint not in embodiment.joint_names:\n"
        '            raise ConfigError(f"there is no joint {self.joint}")\n', "",
        "or a ConfigError of bind(embodiment)",
    ),
    "slow": Fault(
        "it_is_quick_enough", "self.last = 0.5 *", "time.sleep(0.012); self.last = 0.5 *",
        "a late command is a jerk",
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Outcomes:
    return outcomes(tmp_path_factory.mktemp("filters"), GOOD, FAULTS)


def test_a_right_filter_passes_every_check(found: Outcomes) -> None:
    check_good(found, checks=9)


@pytest.mark.parametrize("name", FAULTS)
def test_a_wrong_filter_fails_its_own_check(found: Outcomes, name: str) -> None:
    check_fault(found, name, FAULTS[name])


class TestLowPass(ActionFilterConformance):
    entry_point = "LowPass"
    arguments = {"share": 0.5, "joints": ["joint_1"]}  # noqa: RUF012


class TestSnapGripper(ActionFilterConformance):
    entry_point = "SnapGripper"
