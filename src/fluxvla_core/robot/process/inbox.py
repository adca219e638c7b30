"""``Inbox``: what the main process sends to the control process, and whether it still runs."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from types import FrameType

from fluxvla_core.errors import FluxError
from fluxvla_core.robot.control.interrupt import Interrupts
from fluxvla_core.robot.control.safety import BadChunk, Rule, RuleStop, SafetySettings
from fluxvla_core.robot.control.source import Answer
from fluxvla_core.robot.events import Phase
from fluxvla_core.robot.process.link import Link
from fluxvla_core.robot.process.messages import Message, error_of


@dataclass(frozen=True)
class RemoteAnswer(Answer):
    """An answer of the main process; ``number`` is its question's."""

    number: int


class MainSilent(RuleStop):
    """The main process does not run: it was killed or stopped, or one of its threads keeps the
    interpreter."""

    rule = Rule.MAIN_PROCESS


class Inbox(Interrupts):
    """What the main process sends, and whether it still runs; checked at every tick.

    Signals are the main process's: it passes them on as orders.

    Args:
        link: the control process's end.
        safety: how long the main process may be silent.

    ``watch`` is called at every tick while the arm moves, and raises what is to stop it.
    """

    def __init__(self, link: Link, safety: SafetySettings) -> None:
        super().__init__()
        self.phase = Phase.OVER
        self.orders: deque[Message] = deque()
        self.answers: dict[int, Future[Answer]] = {}
        self.replies: dict[str, Message] = {}
        self._link = link
        self._safety = safety
        self._main = os.getppid()
        self._fault: FluxError | None = None
        self.watch: Callable[[], None] = lambda: None

    def check(self) -> None:
        """Take what came.

        Raises:
            Interrupted: the main process got a signal.
            MainSilent: it has not run for too long.
            FluxError: what the main process, or ``watch``, says is wrong.
        """
        self.poll()
        super().check()
        if self.stopping:
            return
        if self._fault is not None:
            error, self._fault = self._fault, None
            raise error
        self._check_silence()
        if self.phase.moving:
            self.watch()

    @property
    def orphaned(self) -> bool:
        """Whether the main process is dead."""
        return os.getppid() != self._main

    def poll(self) -> None:
        """Take what came, and let the main process know that this one runs."""
        self._link.beat()
        self._link.flush()
        while (message := self._link.receive()) is not None:
            self._take(message)

    def forget(self) -> None:
        """An episode begins: what came for the one before does not count."""
        self._fault, self._pending = None, None
        self.stopping = False
        self.answers.clear()
        self.replies.clear()
        self.signals.clear()

    def order(self) -> Message | None:
        """The oldest order that was not carried out yet."""
        self.poll()
        return self.orders.popleft() if self.orders else None

    def _take(self, message: Message) -> None:
        match message.kind:
            case "answer":
                future = self.answers.pop(message["number"], None)
                if future is not None:
                    _resolve(future, message)
            case "reply":
                self.replies[message["to"]] = message
            case "signal":
                self.on_signal(message["number"], None)
            case "fault":
                self._fault = error_of(message.fields)
            case kind:
                if kind == "play":
                    # Here, not when it is carried out: what comes after it is for this episode.
                    self.forget()
                self.orders.append(message)

    def on_signal(self, number: int, frame: FrameType | None) -> None:
        self.signals.append(number)
        if not self.stopping:
            self._pending = number

    def _check_silence(self) -> None:
        if self.orphaned:
            raise MainSilent("the main process was killed", cause="look for it in the system log")
        # An arm that rests is held until the policy has warmed up, however that takes its time.
        name = "silence_s" if self.phase.moving else "first_chunk_s"
        most, silent = getattr(self._safety, name), self._link.silent_s()
        if silent > most:
            raise MainSilent(
                f"the main process did not run for {silent:.2f} s, safety.{name} is {most:g}",
                cause="it was stopped, the policy or a hook kept the interpreter's lock, or this "
                "machine has no processor to spare",
                next="look at what the policy computes in one piece of native code",
            )


def _resolve(future: Future[Answer], message: Message) -> None:
    fields = message.fields
    if "error" in fields:
        future.set_exception(error_of(fields))
        return
    observed, number = fields["observed"], fields["number"]
    if message.arrays:
        future.set_result(RemoteAnswer(observed, message.arrays[0], None, number))
        return
    refused = error_of(fields["refused"])
    error = refused if isinstance(refused, BadChunk) else BadChunk(refused.what)
    future.set_result(RemoteAnswer(observed, None, error, number))
