"""Action filters of the control process have a time limit; the limits of the arm come after all."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from fluxvla_core.contracts.robot import ActionFilter
from fluxvla_core.control.clock import SimulatedClock
from fluxvla_core.control.filters import LowPass, SnapGripper, WorkspaceBox
from fluxvla_core.control.limits import CommandLimiter
from fluxvla_core.control.safety import BadCommand, FilterLate, Latch, rule_of
from fluxvla_core.control.sender import CommandSender
from fluxvla_core.robot.process.timed_filters import (
    MOST_LATE,
    RESET_S,
    SHARE,
    TimedFilter,
    timed_filters,
)
from fluxvla_core.spec import EmbodimentSpec, Joint

SPEC = EmbodimentSpec(
    "arm",
    (Joint("a", "rad", -1.0, 1.0, 2.0, 10.0), Joint("b", "rad", -1.0, 1.0, 2.0, 10.0)),
    (),
    50.0,
)
POSE = np.array([0.1, 0.2])
# Long enough for a busy machine to have a thread run within it.
PATIENT_S = 5.0


class Add(ActionFilter):
    """Adds ``amount`` once ``wait`` returned; notes what it was given, and its threads."""

    def __init__(self, amount=1.0, wait=lambda: None):
        self.amount, self.wait = amount, wait
        self.given, self.poses, self.threads = [], [], set()

    def reset(self, pose):
        self.poses.append(pose)

    def __call__(self, action):
        self.given.append(action.copy())
        self.threads.add(threading.current_thread())
        self.wait()
        # In place, as users do it.
        action += self.amount
        return action


class Gate:
    """Lets a filter pass, or keeps it until it is opened."""

    def __init__(self):
        self._open, self.entered = threading.Event(), threading.Semaphore(0)

    def __call__(self):
        self.entered.release()
        assert self._open.wait(60)

    def open(self):
        self._open.set()


@pytest.fixture
def gate():
    made = Gate()
    yield made
    made.open()


class Told:
    """What was reported."""

    def __init__(self):
        self.warnings, self.left_out = [], []

    def timed(self, inner, share_s=PATIENT_S):
        return TimedFilter(inner, share_s, self.warnings.append, self.left_out.append)


@pytest.fixture
def told():
    return Told()


def until(condition):
    deadline = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.001)


def test_a_filter_in_time_changes_the_action_in_a_thread_of_its_own(told):
    inner = Add()
    timed = told.timed(inner)

    for number in range(20):
        np.testing.assert_array_equal(timed(POSE + number), POSE + number + 1)

    assert len(inner.threads) == 1
    assert threading.current_thread() not in inner.threads
    assert (told.warnings, told.left_out) == ([], [])


def test_one_that_takes_a_share_of_the_period_is_in_time(told):
    timed = told.timed(Add(wait=lambda: time.sleep(0.005)))

    np.testing.assert_array_equal(timed(POSE), POSE + 1)
    assert told.left_out == []


def test_one_that_takes_longer_is_left_out_reported_once_and_counted(told):
    inner = Add()
    timed = told.timed(inner)

    for _ in range(2):
        # Kept until it was given up: one that only sleeps may end first on a machine that stalls.
        inner.wait = gate = Gate()
        timed._share_s, began = 0.005, time.monotonic()
        np.testing.assert_array_equal(timed(POSE), POSE)
        assert time.monotonic() - began < PATIENT_S
        gate.open()
        # By the next command it is done, and in time: what it made for this one is dropped.
        until(lambda: not timed._results.empty())
        inner.wait, timed._share_s = (lambda: None), PATIENT_S
        np.testing.assert_array_equal(timed(POSE * 2), POSE * 2 + 1)

    assert told.left_out == ["Add"] * 2
    assert told.warnings == [
        "action filter Add did not return within 5 ms and was left out of a command"
    ]


def test_one_that_hangs_is_given_nothing_more_and_ends_the_motion(told, gate):
    inner = Add(wait=gate)
    timed = told.timed(inner, 0.02)

    began = time.monotonic()
    for _ in range(MOST_LATE - 1):
        np.testing.assert_array_equal(timed(POSE), POSE)
    with pytest.raises(FilterLate, match=r"action filter Add .* 3 commands in a row") as caught:
        timed(POSE)

    assert rule_of(caught.value) == "filter"
    # While the thread is busy, nobody waits for it.
    assert time.monotonic() - began < PATIENT_S
    assert len(inner.given) == 1
    assert told.left_out == ["Add"] * MOST_LATE
    assert len(told.warnings) == 1


def test_the_late_result_is_dropped_also_where_it_was_made_in_place(told, gate):
    inner = Add(wait=gate)
    timed, action = told.timed(inner, 0.02), POSE.copy()

    kept = timed(action)
    gate.open()
    until(lambda: not timed._results.empty())

    np.testing.assert_array_equal(kept, POSE)
    np.testing.assert_array_equal(action, POSE)
    inner.wait = lambda: None
    np.testing.assert_array_equal(timed(POSE * 3), POSE * 3 + 1)
    np.testing.assert_array_equal(inner.given, [POSE, POSE * 3])


def test_late_commands_count_in_a_row_only(told):
    inner = Add()
    timed = told.timed(inner, 0.02)

    for _ in range(3):
        gates = Gate()
        inner.wait = gates
        for _ in range(MOST_LATE - 1):
            timed(POSE)
        gates.open()
        until(lambda: not timed._results.empty())
        inner.wait = lambda: None
        timed._share_s = PATIENT_S
        np.testing.assert_array_equal(timed(POSE), POSE + 1)
        timed._share_s = 0.02


@pytest.mark.parametrize("error", [ValueError("no"), SystemExit(3), BadCommand("outside")])
def test_what_a_filter_raises_is_raised_where_commands_are_made(told, error):
    def fail():
        raise error

    inner = Add(wait=fail)
    timed = told.timed(inner)

    with pytest.raises(type(error)) as caught:
        timed(POSE)
    assert caught.value is error
    # The thread lives.
    inner.wait = lambda: None
    np.testing.assert_array_equal(timed(POSE), POSE + 1)
    assert told.left_out == []


def test_what_it_raises_too_late_is_raised_at_the_next_command(told, gate):
    def fail():
        gate()
        raise BadCommand("outside of the box")

    timed = told.timed(Add(wait=fail), 0.02)
    np.testing.assert_array_equal(timed(POSE), POSE)
    gate.open()
    until(lambda: not timed._results.empty())

    with pytest.raises(BadCommand, match="outside of the box"):
        timed(POSE)


@pytest.mark.parametrize("made", [[1.0], [[1.0, 2.0]], 3.0, [1.0, 2.0, 3.0]])
def test_an_action_of_another_shape_names_the_filter(told, made):
    class Odd(ActionFilter):
        def __call__(self, action):
            return made

    with pytest.raises(BadCommand, match=r"action filter Odd made an action of shape .* \(2,\)"):
        told.timed(Odd())(POSE)


def test_an_episode_begins_anew(told, gate):
    inner = Add(wait=gate)
    timed = told.timed(inner, 0.02)
    for _ in range(MOST_LATE - 1):
        timed(POSE)

    gate.open()
    timed.reset(POSE * 2)

    np.testing.assert_array_equal(inner.poses, [POSE * 2])
    inner.wait = closed = Gate()
    for _ in range(MOST_LATE - 1):
        timed(POSE)
    # Each of the two episodes has its report.
    assert len(told.warnings) == 2
    closed.open()


def test_a_filter_that_still_hangs_is_not_reset(told, gate):
    inner = Add(wait=gate)
    timed = told.timed(inner, 0.02)
    timed(POSE)

    began = time.monotonic()
    with pytest.raises(FilterLate, match="Add was not ready for the episode"):
        timed.reset(POSE)

    assert time.monotonic() - began >= RESET_S * 0.9
    assert inner.poses == []


def test_a_reset_that_hangs_or_raises(told, gate):
    class Slow(Add):
        def reset(self, pose):
            gate()

    class Failing(Add):
        def reset(self, pose):
            raise ValueError("no map of this room")

    with pytest.raises(FilterLate, match="Slow was not ready for the episode") as caught:
        told.timed(Slow()).reset(POSE)
    assert "bind()" in caught.value.next
    with pytest.raises(ValueError, match="no map"):
        told.timed(Failing()).reset(POSE)


def test_two_filters_keep_their_order_and_share_the_time(told, gate):
    class Double(Add):
        def __call__(self, action):
            return super().__call__(action) * 2

    slow = Add(0.5, wait=gate)
    made = timed_filters([Add(1.0), slow, Double(0.0)], 50.0, told.warnings.append,
                         told.left_out.append)  # fmt: skip
    assert [each._share_s for each in made] == [pytest.approx(SHARE / 50.0 / 3)] * 3
    for each in made:
        each._share_s = 0.02 if each.name == "Add" and each._inner is slow else PATIENT_S

    def through(action):
        for each in made:
            action = each(action)
        return action

    # The second is left out: the third gets what the first made.
    np.testing.assert_allclose(through(POSE), (POSE + 1) * 2)
    gate.open()
    until(lambda: not made[1]._results.empty())
    slow.wait = lambda: None
    made[1]._share_s = PATIENT_S
    np.testing.assert_allclose(through(POSE), (POSE + 1.5) * 2)
    assert told.left_out == ["Add"]


class OwnCorners(WorkspaceBox):
    """A box as ``URWorkspaceBox`` is one."""

    api = "1.0"

    def __init__(self):
        super().__init__([-1] * 3, [1] * 3, ["a"], links=[{"axis": [0, 0, 1]}])


class Searching(OwnCorners):
    def _inside(self, joints):
        return super()._inside(joints)


class Smoother(LowPass):
    def __call__(self, action):
        return super().__call__(action)


class Duck:
    def __call__(self, action):
        return action


@pytest.mark.parametrize(
    ("made", "direct"),
    [
        (SnapGripper(0.05), True),
        (LowPass(0.5), True),
        (OwnCorners(), True),
        (Searching(), False),
        (Smoother(0.5), False),
        (Add(), False),
        (ActionFilter.adapt(Duck()), False),
    ],
    ids=lambda each: type(each).__name__,
)
def test_filters_that_are_known_to_be_quick_cost_no_thread(told, made, direct):
    (found,) = timed_filters([made], 50.0, told.warnings.append, told.left_out.append)

    assert (found is made) is direct
    if not direct:
        assert isinstance(found, TimedFilter)
        assert found.name == type(made).__name__


@pytest.mark.parametrize("seed", range(5))
def test_whatever_filters_do_in_time_or_late_the_limits_hold(told, seed):
    rng = np.random.default_rng(seed)

    class Wild(ActionFilter):
        def __call__(self, action):
            time.sleep(rng.choice([0.0, 0.0, 0.001, 0.004]))
            return action + rng.normal(0.0, 3.0, 2)

    filters = [told.timed(Wild(), 0.002), told.timed(Wild(), 0.002)]
    limiter, sent = CommandLimiter(SPEC, 0.02), [np.zeros(2), np.zeros(2)]
    clock = SimulatedClock()

    def execute(actions, rate):
        for action in actions:
            sent.append(action.copy())
            clock.advance(0.02)
            rate.sleep()

    sender = CommandSender(
        execute, 50.0, clock, limiter, Latch(clock.now), filters, one_by_one=True
    )
    limiter.start([0.0, 0.0])
    stops = 0
    for _ in range(40):
        try:
            sender.send_targets(rng.uniform(-2, 2, (5, 2)))
        except FilterLate:
            stops += 1
            sender.brake()
            for each in filters:
                each.reset(limiter.last)
    sender.brake()

    assert told.left_out, "some were late"
    path = np.array(sent)
    speed = np.diff(path, axis=0) * 50.0
    push = np.diff(speed, axis=0) * 50.0
    assert np.abs(path).max() <= 1.0
    assert np.abs(speed).max() <= 2.0 + 1e-9
    assert np.abs(push).max() <= 10.0 + 1e-6
    assert limiter.at_rest


def test_commands_are_made_when_their_turn_comes(told):
    order = []

    class Noting(ActionFilter):
        def __call__(self, action):
            order.append("filter")
            return action

    limiter, clock = CommandLimiter(SPEC, 0.02), SimulatedClock()

    def execute(actions, rate):
        order.extend(["send"] * len(actions))
        clock.advance(0.02 * len(actions))
        rate.sleep()

    sender = CommandSender(
        execute, 50.0, clock, limiter, Latch(clock.now), [Noting()], one_by_one=True
    )
    limiter.start([0.0, 0.0])
    sender.send_targets(np.zeros((3, 2)))

    assert order == ["filter", "send"] * 3
