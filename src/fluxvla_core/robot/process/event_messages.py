"""Events of an episode as messages from the control process to the main process."""

from __future__ import annotations

from dataclasses import asdict

from fluxvla_core.control.limits import Clamp
from fluxvla_core.control.safety import Trip
from fluxvla_core.control.sender import SentCommand
from fluxvla_core.robot.events import (
    CommandSent,
    EpisodeEnded,
    Event,
    FilterLeftOut,
    Phase,
    Stopped,
    StoppedWhileHeld,
)
from fluxvla_core.robot.process.messages import Kind, Message


def event_message(event: Event) -> Message | None:
    """``event`` as a message; None for one that the main process emits itself."""
    match event:
        case CommandSent(at, sent, phase, state, send_s, late_s):
            fields = {
                "at": at,
                "phase": phase.value,
                "held": sent.held,
                "clamps": [asdict(clamp) for clamp in sent.clamps],
                "send_s": send_s,
                "late_s": late_s,
            }
            arrays = (sent.target, sent.command)
            return Message(Kind.COMMAND, fields, arrays if state is None else (*arrays, state))
        case FilterLeftOut():
            return Message(Kind.FILTER_LEFT_OUT, vars(event))
        case Stopped():
            return Message(Kind.STOPPED, vars(event))
        case StoppedWhileHeld(at, trip, failure):
            held = {"at": at, "trip": asdict(trip), "failure": failure}
            return Message(Kind.STOPPED_WHILE_HELD, held)
        case EpisodeEnded():
            return Message(Kind.ENDED, {**vars(event), "trips": [asdict(t) for t in event.trips]})
    return None


def event_of(message: Message) -> Event | None:
    """The event of ``event_message``; None for a message of another kind."""
    fields = dict(message.fields)
    match message.kind:
        case Kind.COMMAND:
            target, command, *state = message.arrays
            clamps = tuple(Clamp(**clamp) for clamp in fields["clamps"])
            sent = SentCommand(target, command, clamps, fields["held"])
            return CommandSent(
                fields["at"],
                sent,
                Phase(fields["phase"]),
                state[0] if state else None,
                fields["send_s"],
                fields["late_s"],
            )
        case Kind.FILTER_LEFT_OUT:
            return FilterLeftOut(**fields)
        case Kind.STOPPED:
            return Stopped(**fields)
        case Kind.STOPPED_WHILE_HELD:
            return StoppedWhileHeld(fields["at"], Trip(**fields["trip"]), fields["failure"])
        case Kind.ENDED:
            trips = tuple(Trip(**trip) for trip in fields.pop("trips"))
            return EpisodeEnded(trips=trips, **fields)
    return None
