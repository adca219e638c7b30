"""``Inbox``: receives the main process's messages in the control process, and sees that it runs."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from types import FrameType

from fluxvla_core.control.interrupt import Interrupts
from fluxvla_core.control.policy_client import Answer
from fluxvla_core.control.safety import BadChunk, Rule, RuleStop, SafetySettings
from fluxvla_core.errors import FluxError
from fluxvla_core.robot.events import Phase
from fluxvla_core.robot.process.link import Link, SilenceWatch
from fluxvla_core.robot.process.messages import Kind, Message, error_of

# Without a check for so long, and for so many ticks, this process was paused.
_PAUSED_S, _PAUSED_TICKS = 0.1, 3.0


@dataclass(frozen=True)
class RemoteAnswer(Answer):
    """An answer of the main process; ``number`` is its query's."""

    number: int


class MainSilent(RuleStop):
    """The main process does not run: it was killed or stopped, or one of its threads holds the
    GIL."""

    rule = Rule.MAIN_PROCESS


class Inbox(Interrupts):
    """The control process's end of the link: takes what the main process sends, at every tick.

    It is the ``interrupts`` of the control process's episodes: the main process gets the signals
    and sends them on, and ``check`` raises them here. It also raises where the main process fell
    silent or reports a fault.

    Args:
        link: the control process's end.
        safety: how long the main process may be silent.
        main: the main process's id. This process may have another parent already.
        rate_hz: how often ``check`` is called while the arm moves; fewer calls show that this
            process was paused, perhaps with the whole machine.

    ``watch`` is called at every tick while the arm moves, and raises what is to stop it.
    """

    def __init__(self, link: Link, safety: SafetySettings, main: int, rate_hz: float) -> None:
        super().__init__()
        self.phase = Phase.OVER
        self.orders: deque[Message] = deque()
        self.answers: dict[int, Future[Answer]] = {}
        self.replies: dict[str, Message] = {}
        self._link = link
        self._silence = SilenceWatch(link, max(_PAUSED_S, _PAUSED_TICKS / rate_hz))
        self._safety = safety
        self._main = main
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
        self._link.mark_alive()
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
            case Kind.ANSWER:
                future = self.answers.pop(message["number"], None)
                if future is not None:
                    _resolve(future, message)
            case Kind.REPLY:
                self.replies[message["to"]] = message
            case Kind.SIGNAL:
                self.on_signal(message["number"], None)
            case Kind.FAULT:
                self._fault = error_of(message.fields)
            case kind:
                if kind == Kind.RUN_EPISODE:
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
        # An arm that rests is held until the policy has warmed up, however long that takes.
        if self.phase.moving:
            name, most = "silence_s", self._safety.silence_s
        else:
            name, most = "first_chunk_s", self._safety.first_chunk_s
        silent = self._silence.silent_s()
        if silent > most:
            raise MainSilent(
                f"the main process did not run for {silent:.2f} s, safety.{name} is {most:g}",
                cause="it was stopped, the policy or a hook held the GIL, or this "
                "machine has no processor to spare",
                next="look for a native call that holds the GIL too long",
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
