"""Events of an episode arrive in the main process as they were."""

from __future__ import annotations

from dataclasses import fields, is_dataclass

import numpy as np
import pytest

from fluxvla_core.control.limits import Clamp
from fluxvla_core.control.safety import Rule, Trip
from fluxvla_core.control.sender import SentCommand
from fluxvla_core.robot import events
from fluxvla_core.robot.events import (
    ChunkAccepted,
    CommandSent,
    EpisodeEnded,
    EpisodePrepared,
    EpisodeStarted,
    Event,
    FilterSkipped,
    HistoryObserved,
    Observed,
    ObservedFrame,
    Phase,
    Refused,
    Stopped,
    StoppedWhileHeld,
)
from fluxvla_core.robot.process.messages import Message, decode, encode, event_message, event_of
from fluxvla_core.robot.tasks import Task

POSE = np.array([0.1, -np.pi, 1e-300])
CLAMPS = (
    Clamp("elbow", np.float64(2.5), 1.5, "position"),
    Clamp("jaw", float("inf"), 0.0, "velocity"),
)
TASK = Task("1", "wave", False)
READING = ObservedFrame({}, None, POSE, 1.0, 1.0, {})
SENT = [
    SentCommand(POSE, POSE * 0.5, CLAMPS),
    SentCommand(POSE, POSE, (), held=True),
]
TOLD = [
    *(
        CommandSent(12.5, sent, phase, state, send_s, 0.0004)
        for sent in SENT
        for phase in Phase
        for state, send_s in ((None, None), (np.arange(7.0), 0.001))
    ),
    Stopped(3.0, Rule.TRACKING, "the elbow is behind", 0.5, None),
    Stopped(3.0, "temperature", "手", 0.0, "stop() hangs"),
    StoppedWhileHeld(4.0, Trip("operator", "motor 3 is off", 4.0), None),
    StoppedWhileHeld(4.0, Trip("operator", "motor 3 is off", 4.0), "it did not stop"),
    EpisodeEnded(5.0, "done", True, None, 0, ()),
    EpisodeEnded(
        5.0, "failed", None, "no chunk", 3, (Trip("chunk", "x", 4.5), Trip("run", "y", 4.6))
    ),
    FilterSkipped(6.0, "Slow"),
]
OWN = [
    EpisodePrepared(0.0, TASK, 7, 50.0),
    EpisodeStarted(0.0, TASK),
    Observed(0.0, READING),
    HistoryObserved(0.0, READING),
    Refused(0.0, "chunk", {}),
    ChunkAccepted(0.0, READING, POSE[None], {}),
]


def same(left, right):
    """Whether two values are the same, through the fields of dataclasses, with their types."""
    if isinstance(left, np.ndarray):
        return isinstance(right, np.ndarray) and np.array_equal(left, right)
    if is_dataclass(left):
        names = [field.name for field in fields(left)]
        return type(left) is type(right) and all(
            same(getattr(left, name), getattr(right, name)) for name in names
        )
    if isinstance(left, tuple):
        return isinstance(right, tuple) and len(left) == len(right) and all(map(same, left, right))
    return left == right


def test_every_event_is_told_or_the_main_processs_own():
    every = {cls for cls in vars(events).values() if isinstance(cls, type)}
    known = {cls for cls in every if issubclass(cls, Event) and cls is not Event}

    assert {type(event) for event in TOLD} | {type(event) for event in OWN} == known


@pytest.mark.parametrize("event", TOLD, ids=lambda event: type(event).__name__)
def test_an_event_arrives_as_it_was(event):
    message = event_message(event)

    found = event_of(decode(encode(message)))

    assert same(found, event), (found, event)


@pytest.mark.parametrize("event", OWN, ids=lambda event: type(event).__name__)
def test_events_that_the_main_process_emits_are_not_sent(event):
    assert event_message(event) is None


@pytest.mark.parametrize("kind", ["ready", "answer", "", "Command"])
def test_another_message_is_no_event(kind):
    assert event_of(Message(kind, {"at": 1.0})) is None
