"""Messages between the two processes of a robot: a kind, JSON values, and arrays of float64.

Errors and an episode's events are sent as such.

Nothing is pickled: a message can make numbers and text, no objects.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core import errors
from fluxvla_core.control import policy_client, safety
from fluxvla_core.control.limits import Clamp
from fluxvla_core.control.safety import Trip
from fluxvla_core.control.sender import SentCommand
from fluxvla_core.errors import FluxError, RunFailed
from fluxvla_core.robot.events import (
    CommandSent,
    EpisodeEnded,
    Event,
    FilterSkipped,
    Phase,
    Stopped,
    StoppedWhileHeld,
)

Array = npt.NDArray[np.float64]
_HEADER = struct.Struct("<I")
_FIELDS = ("what", "where", "cause", "next")
_ALIGNED = 8
_JSON = json.JSONEncoder(separators=(",", ":"))


class Kind(str, Enum):
    """The kinds of messages; below each are its fields and arrays.

    An error is sent as the fields of ``error_fields``.
    """

    __str__ = str.__str__  # its value, also in Python 3.10, which has no StrEnum

    # Main process -> control process: orders, carried out one after the other. Each is answered by
    # DONE, CLOSE by CLOSED.
    CONNECT = "connect"
    RUN_EPISODE = "run episode"
    """Run an episode: ``task``, ``instruction``, ``free``, ``number``, ``seed``, ``folder``."""
    REARM = "rearm"
    RELEASE = "release"
    """Stop holding the arm."""
    STOP = "stop"
    CLOSE = "close"

    # Main process -> control process: taken at every tick, also while an order is carried out.
    ANSWER = "answer"
    """To QUERY: ``number``, and ``observed`` with the actions or with ``refused``, or an error."""
    REPLY = "reply"
    """To FIRST_STATE, RESET or LATE, which ``to`` names."""
    SIGNAL = "signal"
    """The main process got a signal: ``number``."""
    FAULT = "fault"
    """Something went wrong in the main process, and the robot is to be stopped: an error."""

    # Control process -> main process: its own state.
    READY = "ready"
    """The operator is built; orders are awaited."""
    FAILED = "failed"
    """The control process ends: an error."""
    DONE = "done"
    """``order``, with ``result``, ``signal`` (a number) or an error; after RUN_EPISODE ``facts``,
    ``stop_failure`` and ``holding``, too."""
    CLOSED = "closed"
    """The robot was stopped and disconnected: ``failures``, texts or None."""
    RELEASED = "released"
    """The hold between two episodes ended: an error."""

    # Control process -> main process: requests of an episode.
    FIRST_STATE = "first state"
    """Wait for the first observation; REPLY has its state."""
    RESET = "reset"
    """Reset the policy; REPLY follows."""
    QUERY = "query"
    """Observe, and query the policy: ``number``, and the chunk to continue; ANSWER follows."""
    ACCEPTED = "accepted"
    """The chunk of ANSWER ``number`` is executed."""
    REFUSED = "refused"
    """The chunk of ANSWER ``number`` is refused: not finite, of a wrong shape, or it jumps."""
    LATE = "late"
    """What took longest ``since`` a time; REPLY has ``name``, ``cause``, ``next``, ``seconds``."""

    # Control process -> main process: for people.
    INFO = "info"
    """``text``."""
    WARN = "warn"
    """``text``."""
    ARTIFACT = "artifact"
    """A file: ``artifact`` (its kind), ``path``."""
    LOG = "log"
    """A record of ``logging``: ``logger``, ``level``, ``text``."""

    # Control process -> main process: events of the episode, see ``event_message``.
    COMMAND = "command"
    FILTER_SKIPPED = "filter skipped"
    STOPPED = "stopped"
    STOPPED_WHILE_HELD = "stopped while held"
    ENDED = "ended"


@dataclass(frozen=True)
class Message:
    """One message.

    Args:
        kind: one of ``Kind``.
        fields: JSON values.
        arrays: float64, of any shape.
    """

    kind: str
    fields: Mapping[str, Any] = field(default_factory=dict)
    arrays: Sequence[Array] = ()

    def __getitem__(self, name: str) -> Any:
        return self.fields[name]


def encode(message: Message) -> bytes:
    """``message`` as bytes."""
    arrays = [np.asarray(array, dtype=np.float64) for array in message.arrays]
    shapes = [array.shape for array in arrays]
    header = _JSON.encode([message.kind, message.fields, shapes]).encode()
    # Spaces, so that the numbers after it are aligned in memory.
    header += b" " * (-(_HEADER.size + len(header)) % _ALIGNED)
    return b"".join([_HEADER.pack(len(header)), header, *(array.tobytes() for array in arrays)])


def decode(data: bytes) -> Message:
    """The message that ``encode`` made bytes of; its arrays are read-only."""
    (length,) = _HEADER.unpack_from(data)
    end = _HEADER.size + length
    kind, fields, shapes = json.loads(data[_HEADER.size : end])
    arrays = []
    for shape in shapes:
        count = int(np.prod(shape, dtype=np.int64))
        arrays.append(np.frombuffer(data, np.float64, count, end).reshape(shape))
        end += count * 8
    return Message(kind, fields, tuple(arrays))


def error_fields(error: BaseException) -> dict[str, Any]:
    """``error`` as JSON values: its class and bases by name, its rule, and its message."""
    names = [cls.__name__ for cls in type(error).__mro__]
    if isinstance(error, FluxError):
        said = {name: getattr(error, name) for name in _FIELDS}
        return {"error": names, "rule": error.rule, **said}
    return {"error": names, "rule": "", "what": f"{type(error).__name__}: {error}"}


def error_of(fields: Mapping[str, Any]) -> FluxError:
    """The error of ``error_fields``, of the nearest class that is known here."""
    found = next((_KNOWN[name] for name in fields["error"] if name in _KNOWN), RunFailed)
    said = {name: fields.get(name) for name in _FIELDS[1:]}
    error = found(fields["what"], **said)
    if error.rule != fields["rule"]:
        # A class of a plugin: what it is called is lost, which rule it belongs to is not.
        error.rule = fields["rule"]  # type: ignore[misc]
    return error


def _classes(*modules: Any) -> dict[str, type[FluxError]]:
    found = [value for module in modules for value in vars(module).values()]
    return {c.__name__: c for c in found if isinstance(c, type) and issubclass(c, FluxError)}


_KNOWN = _classes(errors, safety, policy_client)


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
        case FilterSkipped():
            return Message(Kind.FILTER_SKIPPED, vars(event))
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
        case Kind.FILTER_SKIPPED:
            return FilterSkipped(**fields)
        case Kind.STOPPED:
            return Stopped(**fields)
        case Kind.STOPPED_WHILE_HELD:
            return StoppedWhileHeld(fields["at"], Trip(**fields["trip"]), fields["failure"])
        case Kind.ENDED:
            trips = tuple(Trip(**trip) for trip in fields.pop("trips"))
            return EpisodeEnded(trips=trips, **fields)
    return None
