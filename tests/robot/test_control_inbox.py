"""Which episode a message of the main process is for."""

from __future__ import annotations

import os
import signal

import pytest

from fluxvla_core.control.interrupt import Interrupted
from fluxvla_core.control.safety import SafetySettings
from fluxvla_core.robot.process.inbox import Inbox
from fluxvla_core.robot.process.link import Link, make_memory
from fluxvla_core.robot.process.messages import Kind


@pytest.fixture
def ends():
    memory = make_memory()
    main, control = Link(memory, control=False), Link(memory, control=True)
    os.close(memory)
    return main, Inbox(control, SafetySettings(), os.getppid())


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
