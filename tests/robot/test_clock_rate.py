"""Clocks and the control rate: deadlines do not drift, misses are skipped, not made up for."""

from __future__ import annotations

import itertools
import time

import pytest

from fluxvla_core.contracts.robot import Operator
from fluxvla_core.control.clock import (
    MonotonicClock,
    Rate,
    SimulatedClock,
    clock_of,
    in_lockstep,
)
from fluxvla_core.control.sender import CommandRate


class Stepped:
    """A real-time clock that a test moves: ``sleep_until`` wakes ``late`` seconds too late."""

    lockstep = False

    def __init__(self):
        self.time = 100.0
        self.late = 0.0
        self.slept = []

    def now(self):
        return self.time

    def sleep_until(self, deadline):
        self.slept.append(deadline)
        self.time = max(self.time, deadline) + self.late


def test_deadlines_are_absolute_though_each_wake_is_late():
    clock = Stepped()
    clock.late = 0.003
    rate = Rate(50, clock)

    late = [rate.sleep() for _ in range(4)]

    assert clock.slept == pytest.approx([100.02, 100.04, 100.06, 100.08])
    assert late == pytest.approx([0.003] * 4)
    assert (rate.ticks, rate.skipped) == (4, 0)


def test_work_between_beats_is_part_of_the_period():
    clock = Stepped()
    rate = Rate(50, clock)
    rate.sleep()
    clock.time += 0.015

    assert rate.sleep() == 0.0
    assert clock.slept[-1] == pytest.approx(100.04)


def test_a_missed_deadline_is_skipped_not_made_up_for():
    clock = Stepped()
    rate = Rate(50, clock)
    rate.sleep()
    clock.time += 0.09

    rate.sleep()

    # Deadlines 100.04 to 100.10 are past at 100.11; the tick is the overdue one, the next in time.
    assert rate.skipped == 3
    assert rate.late_s == pytest.approx(0.01)
    rate.sleep()
    assert clock.slept[-1] == pytest.approx(100.12)


def test_a_beat_that_came_late_is_not_followed_by_one_at_once():
    clock = Stepped()
    rate = Rate(50, clock)
    rate.sleep()
    wakes = []
    for late in (0.008, 0.031, 0.0, 0.012, 0.0):
        clock.late = late
        rate.sleep()
        wakes.append(clock.time)

    gaps = [b - a for a, b in itertools.pairwise(wakes)]
    assert min(gaps) >= 0.01 - 1e-9
    assert rate.skipped == 3
    # Back on the grid of the first deadline, not shifted.
    assert (wakes[-1] - 100.0) / 0.02 == pytest.approx(round((wakes[-1] - 100.0) / 0.02))


def test_after_a_reset_a_long_pause_is_no_miss():
    clock = Stepped()
    rate = Rate(50, clock)
    rate.sleep()
    clock.time += 5
    rate.reset()

    rate.sleep()

    assert rate.skipped == 0
    assert clock.slept[-1] == pytest.approx(105.04)


def test_the_supervisor_is_called_at_each_tick_and_can_leave_the_loop():
    ticks = []

    def look():
        ticks.append(rate.ticks)
        if len(ticks) == 3:
            raise KeyError("enough")

    rate = CommandRate(50, Stepped(), 0.0, look)
    rate.sleep()
    rate.sleep()
    with pytest.raises(KeyError, match="enough"):
        rate.sleep()
    assert ticks == [1, 2, 3]


def test_a_lockstep_simulation_is_not_waited_for():
    clock = SimulatedClock()
    rate = Rate(50, clock)

    assert [rate.sleep() for _ in range(3)] == [0.0, 0.0, 0.0]
    assert clock.now() == 0.0
    assert rate.ticks == 3


def test_a_rate_must_be_positive():
    with pytest.raises(ValueError, match="a rate must be positive, got 0 Hz"):
        Rate(0)


def test_simulated_time_passes_by_advancing_alone():
    clock = SimulatedClock(2.0)
    clock.advance(0.5)
    clock.sleep_until(99.0)

    assert clock.now() == 2.5
    with pytest.raises(ValueError, match="time does not run backwards"):
        clock.advance(-0.1)


def test_real_time_waits():
    clock = MonotonicClock()
    begin = time.monotonic()
    clock.sleep_until(clock.now() + 0.02)
    clock.sleep_until(clock.now() - 1)

    assert time.monotonic() - begin >= 0.02


def test_an_operators_own_clock_is_used_and_means_lockstep_unless_it_says_otherwise():
    class Own:
        def now(self):
            return 0.0

        def sleep_until(self, deadline):
            return

    class Robot:
        clock = Own()

    class Plain:
        clock = None

    assert clock_of(Operator.adapt(Robot())) is Robot.clock
    assert isinstance(clock_of(Operator.adapt(Plain())), MonotonicClock)
    assert isinstance(clock_of(Operator.adapt(object())), MonotonicClock)
    assert in_lockstep(Robot.clock)
    assert not in_lockstep(MonotonicClock())
    Own.lockstep = False
    assert not in_lockstep(Robot.clock)


def test_what_takes_a_while_is_made_ready_before_its_deadline():
    clock = Stepped()
    rate = Rate(50, clock, lead_s=0.002)
    sent = []
    for work in (0.0, 0.0005, 0.0015):
        rate.wait()
        sent.append(clock.now())
        rate.sleep()
        clock.time += work
    rate.wait()

    assert sent == pytest.approx([100.0, 100.02, 100.04])
    assert clock.slept == pytest.approx([100.018, 100.02, 100.038, 100.04, 100.058, 100.06])
    assert rate.late_s == 0.0


def test_what_is_not_ready_in_time_is_late_by_what_it_took_longer():
    clock = Stepped()
    rate = Rate(50, clock, lead_s=0.002)
    rate.wait()
    rate.sleep()
    clock.time += 0.005

    assert rate.wait() == pytest.approx(0.003)
    assert rate.sleep() == 0.0
    assert rate.late_s == pytest.approx(0.003), "the wake for the next one was in time"


def test_a_simulation_is_not_waited_for_before_a_command_either():
    rate = Rate(50, SimulatedClock())
    rate.sleep()

    assert rate.wait() == 0.0


@pytest.mark.parametrize("lead_s", [-0.001, 0.02])
def test_a_lead_is_shorter_than_a_period(lead_s):
    with pytest.raises(ValueError, match="a lead must be shorter than a period"):
        Rate(50, lead_s=lead_s)
