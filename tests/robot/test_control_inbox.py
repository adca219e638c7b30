"""What the control process makes of the main process's messages, and of its silence."""

from __future__ import annotations

import os
import signal

import pytest

from fluxvla_core.control.interrupt import Interrupted
from fluxvla_core.control.safety import SafetySettings
from fluxvla_core.errors import SafetyStop
from fluxvla_core.robot.events import Phase
from fluxvla_core.robot.process import link as link_module
from fluxvla_core.robot.process.control_main import _wait
from fluxvla_core.robot.process.inbox import Inbox, MainSilent
from fluxvla_core.robot.process.link import Link, make_memory
from fluxvla_core.robot.process.messages import Kind, error_fields


@pytest.fixture
def ends():
    memory = make_memory()
    main, control = Link(memory, control=False), Link(memory, control=True)
    os.close(memory)
    return main, Inbox(control, SafetySettings(), os.getppid(), 50.0)


def test_a_signal_right_after_the_order_to_run_ends_the_episode(ends):
    main, inbox = ends
    main.send(Kind.RUN_EPISODE)
    main.send("signal", number=signal.SIGINT)

    assert inbox.order().kind == Kind.RUN_EPISODE
    with pytest.raises(Interrupted, match="SIGINT"):
        inbox.check()


def test_what_ended_one_episode_says_nothing_of_the_next(ends):
    main, inbox = ends
    main.send("signal", number=signal.SIGTERM)
    inbox.poll()
    inbox.stopping = True

    main.send(Kind.RUN_EPISODE)
    assert inbox.order().kind == Kind.RUN_EPISODE
    inbox.check()

    main.send("signal", number=signal.SIGINT)
    with pytest.raises(Interrupted, match="SIGINT"):
        inbox.check()


class FakeClock:
    """The machine's time, which both ends see: a pause of a machine cannot be provoked here."""

    def __init__(self):
        self.now = 100.0

    def monotonic(self):
        return self.now

    def monotonic_ns(self):
        return int(self.now * 1e9)


@pytest.fixture
def clock(monkeypatch):
    clock = FakeClock()
    monkeypatch.setattr(link_module, "time", clock)
    return clock


@pytest.fixture
def moving(clock, ends):
    """Both ends of an arm that moves, at 50 commands a second; ``silence_s`` is 0.2."""
    main, inbox = ends
    inbox.phase = Phase.RUN
    main.mark_alive()
    inbox.check()
    return main, inbox


def passes(clock, seconds, inbox, every=0.02):
    """Check at every tick for so long."""
    for _ in range(round(seconds / every)):
        clock.now += every
        inbox.check()


def test_a_main_process_that_does_not_run_is_silent(clock, moving):
    _, inbox = moving
    passes(clock, 0.18, inbox)
    with pytest.raises(MainSilent, match=r"did not run for 0\.2\d s, safety.silence_s is 0.2"):
        passes(clock, 0.06, inbox)


def test_a_machine_that_stands_still_is_no_silent_main_process(clock, moving):
    main, inbox = moving
    for _ in range(3):
        clock.now += 1.0
        inbox.check()
        passes(clock, 0.1, inbox)
        main.mark_alive()
        passes(clock, 0.02, inbox)
    clock.now += 1.0
    with pytest.raises(MainSilent, match=r"did not run for 0\.2\d s"):
        passes(clock, 0.2, inbox)


def test_a_driver_that_blocks_at_every_tick_hides_no_silence(clock, moving):
    _, inbox = moving
    passes(clock, 0.3, inbox, every=0.15)
    with pytest.raises(MainSilent):
        passes(clock, 0.15, inbox, every=0.15)


class FakeHeldArm:
    """A ``LocalEngine`` between two episodes, which records how the hold ends."""

    def __init__(self, fault=None):
        self.holding, self.calls, self.fault = True, [], fault

    def hold(self):
        self.calls.append("hold")
        if self.fault is not None:
            raise self.fault

    def stop(self):
        self.calls.append("stop")

    def stop_held(self, error):
        self.calls.append(("stop_held", error.what))

    def release(self):
        self.calls.append("release")
        self.holding = False


def released(main):
    message = main.receive()
    assert message.kind == Kind.RELEASED
    return message["what"]


def test_a_signal_right_after_an_episode_stops_the_arm_that_is_held(ends):
    main, inbox = ends
    main.send(Kind.SIGNAL, number=signal.SIGINT)
    arm = FakeHeldArm()
    _wait(inbox._link, inbox, arm)
    assert arm.calls == ["stop", "release"]
    assert released(main) == "Interrupted: SIGINT"


def test_a_fault_right_after_an_episode_stops_the_arm_that_is_held(ends):
    main, inbox = ends
    main.send(Kind.FAULT, **error_fields(SafetyStop("the disk is full")))
    arm = FakeHeldArm()
    _wait(inbox._link, inbox, arm)
    assert arm.calls == [("stop_held", "the disk is full"), "release"]
    assert released(main) == "the disk is full"


def test_a_hold_that_fails_has_stopped_the_arm_and_is_not_repeated(ends):
    main, inbox = ends
    arm = FakeHeldArm(SafetyStop("the arm does not stay"))
    _wait(inbox._link, inbox, arm)
    _wait(inbox._link, inbox, arm)
    assert arm.calls == ["hold", "release"]
    assert released(main) == "the arm does not stay"
