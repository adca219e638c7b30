"""The command that holds an arm between tasks: the next task begins there, also after a stop."""

from __future__ import annotations

import numpy as np
import pytest

from fluxvla_core.errors import NotReady, SafetyStop
from fluxvla_core.robot.runner import BaseInferenceRunner
from tests.robot.conftest import TASKS
from tests.robot.faults import nan
from tests.robot.test_sources import Slow


@pytest.fixture
def real(make_arm):
    """Lags behind its commands as arms do: it droops, and its jaw presses on what it holds."""

    class Real(make_arm):
        def get_state(self):
            return self.state.copy()

        def send_action(self, action):
            super().send_action(action)
            if not self.faults.get("stuck"):
                self.state = np.array([action[0] - 0.04, action[1], max(action[2], 0.4)])

    return Real(realtime=True)


@pytest.fixture
def telling(real):
    """Knows its command, too."""

    class Telling(type(real)):
        @property
        def last_action(self):
            return self.sent[-1] if self.sent else None

    return Telling(realtime=True)


@pytest.fixture
def unstoppable(real):
    """Of the specification's shape, without ``stop``: nothing but the loop ever commands it."""

    class Unstoppable(type(real)):
        stop = send_action = None

        def servoj(self, action):
            type(real).send_action(self, action)

    return Unstoppable(realtime=True)


class ServoRunner(BaseInferenceRunner):
    def _execute_actions(self, actions, rate):
        for action in actions:
            self.ros_operator.servoj(action)
            rate.sleep()


@pytest.fixture
def gripping(make_waver):
    """Closes the jaw."""

    class Gripping(make_waver):
        def predict_action(self, observation):
            chunk = super().predict_action(observation)
            if chunk.dtype == np.float64:
                chunk[:, 2] = 0.0
            return chunk

    return Gripping(goal=0.3)


class Acts(Slow):
    """Does something to the arm just before saying each line, for which there is a deed."""

    def __init__(self, deeds, *lines, polls=10):
        super().__init__(*lines, polls=polls)
        self.deeds = deeds

    def ask(self):
        super().ask()
        deed = self.deeds.pop(self.lines[0] if self.lines else None, None)
        if deed is not None:
            deed()


def test_the_next_task_begins_at_the_command_that_holds_the_arm(bench, real, gripping, asked):
    """Not where it droops to; and a gripper does not let go."""
    bench.arm, bench.policy = real, gripping
    asked(Slow("1", "2", polls=3))

    bench.run(task=None, max_publish_step=40)

    ended = len([row for row in bench.trace("001-1") if row["event"] == "command"])
    assert bench.arm.sent[ended - 1][2] == 0.0
    assert len(bench.arm.sent) > 80
    bench.assert_within_limits()


@pytest.mark.parametrize("kind", ["real", "telling"])
def test_after_a_stop_a_moved_arm_begins_where_it_is_and_goes_on_gripping(
    bench, gripping, asked, request, kind
):
    bench.arm, bench.policy = request.getfixturevalue(kind), gripping
    before = []

    def move():
        bench.arm.state[0] += 0.25
        before.extend((len(bench.arm.sent), bench.arm.state[0]))

    asked(Acts({"rearm": move}, "1", "rearm", "2"))
    bench.policy.faults[3] = nan

    bench.run(task=None, max_publish_step=60)

    count, where = before
    earlier, later = bench.arm.sent[:count], bench.arm.sent[count:]
    assert len(later) > 0
    bench.assert_within_limits(sent=earlier)
    bench.assert_within_limits((where, *earlier[-1][1:]), later)


@pytest.mark.parametrize(
    ("kind", "cls"), [("telling", BaseInferenceRunner), ("unstoppable", ServoRunner)]
)
def test_after_a_stop_an_arm_that_stayed_begins_at_the_command_that_holds_it(
    bench, gripping, asked, request, kind, cls
):
    """Not where it droops to: that would be a jump of the command."""
    bench.arm, bench.policy = request.getfixturevalue(kind), gripping
    asked(Slow("1", "rearm", "2"))
    bench.policy.faults[3] = nan

    assert bench.run(cls=cls, task=None, max_publish_step=60)["episodes"] == 1
    ended = len([row for row in bench.trace("001-1") if row["event"] == "command"])
    assert len(bench.arm.sent) > ended > 10
    bench.assert_within_limits()


def test_an_episode_that_never_began_does_not_let_go_of_what_is_held(bench, real, gripping, asked):
    bench.arm, bench.policy = real, gripping
    before = []

    def blind():
        before.append(len(real.sent))
        real.faults["get_frame"] = NotReady("camera front is silent")

    asked(Acts({"2": blind, "rearm": real.faults.clear}, "1", "2", "rearm", "3", polls=0))

    known = {**TASKS, "3": "stir"}
    bench.run(task=None, max_publish_step=40, task_descriptions=known, ready_timeout=0.1)

    jaw = [command[2] for command in real.sent[before[0] - 1 :]]
    assert len(jaw) > 40
    assert max(jaw) == 0.0


def switched_off(arm):
    arm.faults["stuck"] = True
    arm.state[0] = -0.9


def test_an_arm_that_does_not_stay_where_it_is_held_is_stopped(bench, real, gripping, asked):
    bench.arm, bench.policy = real, gripping
    person = asked(Acts({"2": lambda: switched_off(real)}, "1", "2", polls=60))

    with pytest.raises(SafetyStop, match="stopped by rule tracking"):
        bench.run(task=None, max_publish_step=10)
    assert any("away from its command" in told for told in person.told)
    sent = len([row for row in bench.trace("001-1") if row["event"] == "command"])
    assert len(bench.arm.sent) < sent + 200


def test_who_says_so_allows_motion_again_after_that(bench, real, gripping, asked):
    bench.arm, bench.policy = real, gripping
    deeds = {"2": lambda: switched_off(real), "rearm": real.faults.clear}
    asked(Acts(deeds, "1", "2", "rearm", "3", polls=60))

    result = bench.run(task=None, max_publish_step=10, task_descriptions={**TASKS, "3": "stir"})
    assert (result["episodes"], result["task"]) == (2, "3")


def test_an_operator_that_knows_its_command_is_asked_for_it(bench, real, gripping, asked):
    """It may hold something else than what was sent last: what its own stop sent."""
    bench.arm, bench.policy = real, gripping
    real.last_action = None
    count = []

    def elsewhere():
        count.append(len(real.sent))
        real.last_action = real.sent[-1] + [0.1, 0.0, 0.0]

    asked(Acts({"2": elsewhere}, "1", "2", polls=0))
    bench.run(task=None, max_publish_step=30)

    first = real.sent[count[0]]
    np.testing.assert_allclose(first, real.sent[count[0] - 1] + [0.1, 0.0, 0.0], atol=0.03)
