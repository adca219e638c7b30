"""The one way to the robot: what was planned, what was sent, and what happens in between."""

from __future__ import annotations

import numpy as np
import pytest

from fluxvla_core.control.clock import SimulatedClock
from fluxvla_core.control.limits import CommandLimiter
from fluxvla_core.control.safety import Latch
from fluxvla_core.control.sender import CommandSender
from fluxvla_core.errors import SafetyStop
from fluxvla_core.spec import EmbodimentSpec, Joint

ONE = EmbodimentSpec("one", (Joint("j", "rad", -1.0, 1.0, 2.0, 10.0),), (), 50.0)


class Rig:
    def __init__(self, execute=None, filters=()):
        self.robot, self.sent = [], []
        self.limiter = CommandLimiter(ONE, 0.02)
        self.limiter.start([0.0])
        self.latch = Latch(lambda: 4.0)
        self.path = CommandSender(
            execute or self.execute,
            50,
            SimulatedClock(),
            self.limiter,
            self.latch,
            filters,
            lambda sent, sent_at, late_s: self.sent.append(sent),
        )

    def execute(self, actions, rate):
        for action in actions:
            self.robot.append(float(action[0]))
            rate.sleep()


def pushes(values):
    speed = np.diff([0.0, 0.0, *values]) * 50
    return np.abs(np.diff(speed)).max() * 50


def test_each_target_is_reported_with_its_command_at_its_tick():
    rig = Rig()

    rig.path.send_targets([[0.001], [0.5]])

    assert [s.target[0] for s in rig.sent] == [0.001, 0.5]
    assert [s.command[0] for s in rig.sent] == rig.robot
    assert rig.sent[0].clamps == ()
    assert [c.reason for c in rig.sent[1].clamps] == ["velocity"]


def test_commands_are_handed_over_read_only():
    def meddle(actions, rate):
        actions[0] = 9.0

    rig = Rig(meddle)
    with pytest.raises(ValueError, match="read-only"):
        rig.path.send_targets([[0.001]])


def test_filters_come_before_the_limits_and_reports_keep_the_plan():
    rig = Rig(filters=[lambda row: row * 1000])

    rig.path.send_targets([[0.1]])

    assert rig.sent[0].target[0] == 0.1
    assert rig.robot[0] < 0.01
    rig.path.send_targets([[0.1]], filtered=False)


def test_holding_brakes_and_then_repeats():
    rig = Rig()
    rig.path.send_targets([[1.0]] * 5)
    for _ in range(8):
        rig.path.hold()

    assert rig.limiter.at_rest
    assert rig.robot[-1] == rig.robot[-2]
    assert pushes(rig.robot) <= 10.0


def test_a_tripped_latch_lets_nothing_through_but_braking():
    rig = Rig()
    rig.path.send_targets([[1.0]] * 5)
    rig.latch.trip("chunk", "not finite")

    for call in (rig.path.hold, lambda: rig.path.send_targets([[0.0]])):
        with pytest.raises(SafetyStop, match="stopped by rule chunk: not finite"):
            call()
    count = len(rig.robot)
    rig.path.brake()
    assert rig.limiter.at_rest
    assert len(rig.robot) > count
    assert pushes(rig.robot) <= 10.0


def test_a_loop_that_stops_half_way_leaves_the_limits_where_it_stopped():
    def three(actions, rate):
        rig.execute(actions[:3], rate)

    rig = Rig(three)
    for _ in range(6):
        rig.path.send_targets([[1.0]] * 10)

    assert len(rig.robot) == 18
    assert pushes(rig.robot) <= 10.0
    assert rig.limiter.last[0] == rig.robot[-1]


def test_a_loop_left_at_a_beat_goes_on_from_the_command_before_it():
    class Enough(Exception):
        pass

    def leave(sent, sent_at, late_s):
        rig.sent.append(sent)
        if len(rig.sent) == 4:
            raise Enough

    rig = Rig()
    rig.path = CommandSender(rig.execute, 50, SimulatedClock(), rig.limiter, rig.latch, (), leave)
    with pytest.raises(Enough):
        rig.path.send_targets([[1.0]] * 10)

    assert rig.limiter.last[0] == rig.robot[-1]
    rig.path.brake()
    assert pushes(rig.robot) <= 10.0


def test_a_command_that_raised_counts_as_sent():
    def break_off(actions, rate):
        rig.execute(actions[:2], rate)
        rig.robot.append(float(actions[2][0]))
        raise OSError

    rig = Rig(break_off)
    with pytest.raises(OSError):
        rig.path.send_targets([[1.0]] * 10)

    assert rig.limiter.last[0] == rig.robot[-1]


def test_what_is_interrupted_before_anything_is_sent_moves_nothing(monkeypatch):
    rig = Rig()
    step, count = rig.limiter.step, iter(range(5))

    def interrupted(*arguments):
        if next(count) == 3:
            raise KeyboardInterrupt
        return step(*arguments)

    monkeypatch.setattr(rig.limiter, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        rig.path.send_targets([[1.0]] * 10)

    assert rig.robot == []
    assert rig.limiter.last[0] == 0.0
    assert rig.limiter.at_rest


def test_a_robot_that_is_slowed_down_in_the_middle_keeps_its_limits_and_stays_with_its_commands():
    rig, shares = Rig(), iter([1.0] * 20 + [0.3] * 30 + [1.0] * 30)
    rig.path = CommandSender(
        rig.execute, 50, SimulatedClock(), rig.limiter, rig.latch, (), speed=lambda: next(shares)
    )
    rig.path.send_targets([[1.4]] * 80)

    pace = np.abs(np.diff(rig.robot)) * 50
    fastest = ONE.joints[0].velocity
    assert pace[:18].max() > 0.9 * fastest
    assert pace[40:48].max() == pytest.approx(0.3 * fastest, rel=1e-3)
    assert pushes(rig.robot) <= ONE.joints[0].acceleration
    rig.path.brake()
    assert pushes(rig.robot) <= ONE.joints[0].acceleration


@pytest.mark.parametrize("speed", [None, lambda: 1.0])
def test_targets_may_be_played_at_a_share_of_the_speed(speed):
    rig = Rig()
    rig.path = CommandSender(
        rig.execute,
        50,
        SimulatedClock(),
        rig.limiter,
        rig.latch,
        (),
        lambda sent, *_: rig.sent.append(sent),
        speed,
    )
    rig.path.send_targets([[1.0]] * 30, most=0.25)

    pace = np.abs(np.diff(rig.robot)) * 50
    assert pace.max() == pytest.approx(0.25 * ONE.joints[0].velocity, rel=1e-3)


def test_a_loop_without_ticks_is_reported_afterwards():
    def unpaced(actions, rate):
        rig.robot.extend(float(a[0]) for a in actions)

    rig = Rig(unpaced)
    rig.path.send_targets([[1.0]] * 4)

    assert [s.command[0] for s in rig.sent] == rig.robot
    assert rig.limiter.last[0] == rig.robot[-1]


def test_a_beat_without_a_command_is_reported_as_none():
    def idle(actions, rate):
        rig.execute(actions, rate)
        rate.sleep()

    rig = Rig(idle)
    rig.path.send_targets([[0.0]])

    assert [s is None for s in rig.sent] == [False, True]
